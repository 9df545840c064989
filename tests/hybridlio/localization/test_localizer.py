"""A second drive through a mapped town, and one through another town."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mapped_towns import MappedTown, TownDrive

from hybridlio.core import se3
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.localizer import LocalizationSettings, Localizer, MapPose
from hybridlio.localization.map_surface import MapSurface
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.start import start_pose
from hybridlio.sources.settings import ScanMatchingSettings


def follow(
    localizer: Localizer, drive: TownDrive, first: int = 1, last: int | None = None, every: int = 1
) -> dict[int, MapPose]:
    """Localise the scans of a drive; return the poses by row."""
    out, before = {}, first
    for k, scan in drive.scans(first, every):
        if last is not None and k > last:
            break
        step = drive.steps[k - 1]
        if every > 1:  # the covariance of several steps
            step = replace(step, covariance=(k - before or 1) * step.covariance)
        before = k
        if (found := localizer.step(scan, drive.poses[k], step, drive.up)) is not None:
            out[k] = found
    return out


def test_a_second_drive_is_found_and_followed_within_centimetres(town: MappedTown, again: TownDrive):
    poses = follow(Localizer(town.prior), again)
    assert min(poses) < 50  # five seconds
    assert np.mean([one.held for one in poses.values()]) > 0.95
    errors = town.errors(again, poses)
    assert np.sqrt((errors[:, 3:] ** 2).sum(axis=1).mean()) < 0.05
    found = pose_consistency(errors, np.array([one.at.covariance for one in poses.values()]))
    assert 0.1 < found.position.value < 3.0
    assert 0.1 < found.rotation.value < 3.0


def test_another_town_is_never_taken_for_the_mapped_one(town: MappedTown, elsewhere: TownDrive):
    assert follow(Localizer(town.prior), elsewhere, every=2) == {}


def test_a_given_start_metres_and_degrees_off_holds_at_the_first_scan(town: MappedTown, again: TownDrive):
    k, scan = next(again.scans(30))
    true = town.true_pose(again.truth[k])
    for dx, dy, degrees in ((1.5, -1.0, 5.0), (-1.5, 1.5, -5.0)):
        yaw = np.arctan2(true[1, 0], true[0, 0]) + np.deg2rad(degrees)
        points_only = PriorMap(MapSurface(town.prior.surface.points), up=town.prior.up)
        localizer = Localizer(points_only)
        start = (float(true[0, 3] + dx), float(true[1, 3] + dy), float(yaw))
        localizer.start(start_pose(points_only, scan, again.up, start), again.poses[k])
        found = localizer.step(scan, again.poses[k], again.steps[k - 1], again.up)
        assert found is not None
        assert found.held
        assert np.linalg.norm(se3.log(se3.between(found.at.pose, true))[3:]) < 0.1


def test_a_given_start_at_another_place_of_the_street_is_not_believed(town: MappedTown, again: TownDrive):
    k, scan = next(again.scans(60))
    surface_only = PriorMap(town.prior.surface, up=town.prior.up)
    for row in (20, 35, 80, 95):
        wrong = town.drive.poses[row]
        start = (float(wrong[0, 3]), float(wrong[1, 3]), float(np.arctan2(wrong[1, 0], wrong[0, 0])))
        localizer = Localizer(surface_only)
        localizer.start(start_pose(surface_only, scan, again.up, start), again.poses[k])
        found = localizer.step(scan, again.poses[k], again.steps[k - 1], again.up)
        assert found is not None
        assert not found.held
        assert found.at.sigma_m > 1.0


def test_beyond_the_map_odometry_goes_on_with_growing_covariance_and_joins_again(town: MappedTown, again: TownDrive):
    places = town.drive.poses[:, :3, 3]
    nearest = np.array([np.linalg.norm(places - p, axis=1).argmin() for p in town.prior.surface.points])
    left = (nearest < 30) | (nearest > 80)  # rows, about a metre apart; the scans below reach 20 m
    prior = PriorMap(MapSurface(town.prior.surface.points[left]), up=town.prior.up)
    near = replace(LocalizationSettings(), thinning=ScanMatchingSettings(max_range_m=20.0, min_points=10))
    localizer = Localizer(prior, near)
    true = town.true_pose(again.truth[1])
    localizer.start(UncertainPose(true, np.eye(6) * 1e-4), again.poses[1])
    poses = follow(localizer, again, 1)
    held = np.array([one.held for one in poses.values()])
    sigmas = np.array([one.at.sigma_m for one in poses.values()])
    assert held[:15].all()
    assert held[-20:].all()
    out = np.flatnonzero(~held)
    assert len(out) > 10
    assert sigmas[out[-1]] > 2 * sigmas[out[0] - 1]
    errors = np.linalg.norm(town.errors(again, poses)[:, 3:], axis=1)
    assert errors[-20:].max() < 0.1
    assert (errors[out] < 5 * sigmas[out]).all()
