"""Places of a map of points alone: viewpoints in free space, views without hidden points, and recognition by them."""

from __future__ import annotations

import numpy as np
import pytest
from mapped_towns import MappedTown, TownDrive

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Scan
from hybridlio.localization.localizer import LocalizationSettings, Localizer
from hybridlio.localization.map_surface import MapSurface
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.view_places import ViewPlaces
from hybridlio.localization.viewpoints import Eye, Viewpoints
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.recording import PlatformRecording, plan
from hybridlio.simulation.sensors.lidar import first_hits, measure
from hybridlio.smoothing.places import levelling_rotations
from hybridlio.sources.thinned_scan import thin

STEP_M = 0.15
EYE = Eye(height_m=1.5, lowest_rad=-0.7, highest_rad=0.7, range_m=20.0, spacing_m=1.0)


def plate(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Array:
    """Return points on a rectangle, a grid between the limits."""
    axes = [np.arange(low, high + 1e-9, STEP_M) for low, high in (x, y, z)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def hall() -> Array:
    """Return a hall of 12 by 8 m, halved at x = 6 by a wall with a door of 2 m."""
    ends = [plate((x, x), (0, 8), (0, 3)) for x in (0, 12)]
    sides = [plate((0, 12), (y, y), (0, 3)) for y in (0, 8)]
    wall = [plate((6, 6), y, (0, 3)) for y in ((0, 3), (5, 8))]
    return np.concatenate([plate((0, 12), (0, 8), (0, 0)), *ends, *sides, *wall])


@pytest.fixture(scope="module")
def viewpoints() -> Viewpoints:
    surface = MapSurface(hall(), scale=0.5)
    return Viewpoints(surface.points, surface.normals, EYE, 0.5)


def test_viewpoints_lie_above_the_floor_clear_of_walls_and_cover_it(viewpoints: Viewpoints):
    at = viewpoints.positions
    np.testing.assert_allclose(at[:, 2], 1.5, atol=0.05)
    assert (np.abs(at[:, 0] - 6) > 0.25)[np.abs(at[:, 1] - 4) > 1.2].all()
    assert 0.2 < at[:, 0].min() < 1.5
    assert 10.5 < at[:, 0].max() < 11.8
    assert len(at) > 0.5 * 12 * 8 / EYE.spacing_m**2


def test_a_view_holds_what_is_seen_and_nothing_behind_walls(viewpoints: Viewpoints):
    k = int(np.linalg.norm(viewpoints.positions - [3.0, 1.5, 1.5], axis=1).argmin())
    seen = viewpoints.view(k) + viewpoints.positions[k]
    assert ((seen[:, 0] < 6.3) | (np.abs(seen[:, 1] - 4) > 1.0) | (seen[:, 0] > 6.3)).all()
    behind = seen[(seen[:, 0] > 6.5) & (seen[:, 1] < 3.0)]
    assert len(behind) == 0  # in the shadow of the wall, away from the door
    assert (seen[:, 0] > 9.0).sum() > 20  # through the door
    near_end = seen[(np.abs(seen[:, 0]) < 0.1) & (seen[:, 2] > 0.5)]
    assert len(near_end) > 0.5 * len(plate((0, 0), (0, 8), (0.5, 3))) * (STEP_M / 0.3) ** 2


@pytest.mark.parametrize("tilt", [(0.2, 0.0, 0.0), (-0.1, 0.3, 0.0)])
def test_the_floor_tells_which_way_is_up(tilt: tuple[float, float, float]):
    R = se3.so3_exp(tilt)
    up = MapSurface(hall() @ R.T, scale=0.5).level()
    assert np.degrees(np.arccos(up @ R @ [0.0, 0.0, 1.0])) < 0.2


def still_scan(recording: PlatformRecording, seconds: float, seed: int) -> tuple[Scan, Array]:
    """Return a scan taken at rest, and its pose in the world."""
    scanner = SCANNERS[recording.config.lidar]
    pattern = scanner.sweep(seconds)
    pose = recording.lidar_poses(np.array([seconds]))[0]
    count = len(pattern.column_offset_ns)
    hits = first_hits(recording.rays, [], pattern, np.tile(pose, (count, 1, 1)), np.full(count, seconds))
    return measure(hits, pattern, scanner.model, 0, False, np.random.default_rng(seed)), pose


def office(drive_seed: int | None = None) -> PlatformRecording:
    return plan(PlatformConfig(scene="office", lidar="vlp-16", seconds=24.0, seed=5, drive_seed=drive_seed))


def test_another_walk_through_an_office_is_recognised_by_single_scans_of_16_beams():
    maker, walk = office(), office(drive_seed=6)
    still = [still_scan(maker, t, k) for k, t in enumerate(np.arange(0.0, 24.0, 0.4))]
    prior = PriorMap.of(np.concatenate([se3.transform(pose, scan.points) for scan, pose in still])).at_scale(0.5)
    settings = LocalizationSettings().at_scale(0.5)
    places, errors = ViewPlaces(prior.surface, prior.up, settings.matching), []
    for k, t in enumerate(np.arange(1.0, 23.0, 3.0)):
        scan, pose = still_scan(walk, t, 100 + k)
        level = levelling_rotations(pose[None], np.array([0.0, 0.0, 1.0]))[0]
        found = places.recognise(thin(scan, settings.thinning), level)
        errors.append(np.inf if found is None else np.linalg.norm(found.found.pose[:3, 3] - pose[:3, 3]))
    assert np.mean(np.array(errors) < 0.08) >= 0.6


def test_a_drive_is_found_in_a_map_of_points_alone_and_another_town_is_not(
    town: MappedTown, again: TownDrive, elsewhere: TownDrive
):
    points = town.prior.surface.points
    prior = PriorMap.of(points[np.linalg.norm(points - town.drive.poses[25, :3, 3], axis=1) < 60.0])
    localizer, found = Localizer(prior), None
    for k, scan in again.scans(1):
        found = localizer.step(scan, again.poses[k], again.steps[k - 1], again.up)
        if found is not None:
            break
    assert found is not None
    assert k < 30
    assert np.linalg.norm(town.errors(again, {k: found})[0, 3:]) < 0.1
    localizer.forget()  # keeps the rendered views
    for k, scan in elsewhere.scans(1, every=4):
        assert localizer.step(scan, elsewhere.poses[k], elsewhere.steps[k - 1], elsewhere.up) is None
        if k > 32:
            break
