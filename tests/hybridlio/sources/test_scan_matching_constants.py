"""Scan matching's limits: what each decides, on a short drive with a 16-beam sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matching import guess, true_pose, with_points
from walks import errors_of, estimated, walk

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.sources import map_errors, scan_matching
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.settings import ScanMatchingSettings
from hybridlio.sources.thinned_scan import thin


def certain_to(rotation_rad: float, translation_m: float) -> np.ndarray:
    """A covariance with these standard deviations."""
    return np.diag(np.r_[np.full(3, rotation_rad), np.full(3, translation_m)] ** 2)


NEAR = certain_to(0.001, 0.02)


def unknown(rotation_rad: float | None = None) -> RelativePose:
    """No motion, with an unknown speed, and an unknown turn unless a standard deviation is given."""
    covariance = unknown_motion_covariance(0.1)
    if rotation_rad is not None:
        covariance[:3, :3] = np.eye(3) * rotation_rad**2
    return RelativePose(np.eye(4), covariance, "none")


def driven(sequence: Sequence, frames: list[Frame], steps: int) -> ScanMatching:
    matching = ScanMatching()
    matching.start(frames[0])
    for k in range(1, steps + 1):
        assert matching.refine(frames[k], guess(true_pose(sequence, k - 1, k), NEAR)).ok
    return matching


# ---------------------------------------------------------------------------------------------------- a young map


def standing(frames: list[Frame], rng: np.random.Generator, steps: int) -> list[RelativePose]:
    """Steps of a sensor at rest whose every scan becomes a keyframe, so that only the map's age changes."""
    settings = ScanMatchingSettings()
    settings = replace(settings, local_map=replace(settings.local_map, keyframe_m=1e-9))
    matching, found, points = ScanMatching(settings), [], frames[0].scan.points
    for k in range(steps + 1):
        scan = with_points(frames[k], points + 0.01 * rng.standard_normal(points.shape))
        if k:
            found.append(matching.refine(scan, guess(np.eye(4), NEAR)))
        else:
            matching.start(scan)
    return found


def test_a_map_of_one_keyframe_is_less_certain_than_one_of_many(frames: list[Frame], rng: np.random.Generator):
    """The first keyframe has ground along its own rings only, and normals between them are guesses."""
    first, *_, last = standing(frames, rng, 14)
    ratio = np.trace(first.covariance[3:, 3:]) / np.trace(last.covariance[3:, 3:])
    assert 1.8 < ratio < 6.0


def test_half_of_the_first_keyframes_error_is_drift_and_later_less(frames: list[Frame], rng: np.random.Generator):
    """A map is as wrong as the few scans that it consists of."""
    shares = [np.trace(step.drift) / np.trace(step.covariance) for step in standing(frames, rng, 14)]
    assert 0.2 < shares[0] <= 0.5
    assert shares[-1] == pytest.approx(ScanMatchingSettings().drift_share)


def test_steps_along_a_map_of_one_scan_drift_by_a_tenth(sequence: Sequence, frames: list[Frame]):
    """The planes between its rings lean, and other ones are met as the sensor moves on."""
    matching = ScanMatching(
        replace(ScanMatchingSettings(), local_map=replace(ScanMatchingSettings().local_map, keyframe_m=50.0))
    )
    matching.start(frames[0])
    steps = [matching.refine(frames[k], guess(true_pose(sequence, k - 1, k), NEAR)) for k in (1, 2, 3)]
    for step in steps[1:]:
        assert step.drift is not None
        assert 0.05 < np.trace(step.drift) / np.trace(step.covariance) < 0.2


def test_steps_along_an_unchanged_map_of_many_scans_do_not_drift():
    """Their errors against the same map cancel; the covariance of the drift stays definite."""
    shares = [map_errors.drift_share(False, keyframes, 0.1) for keyframes in (1, 3, 10, 40)]
    assert shares == sorted(shares, reverse=True)
    assert 0 < shares[-2] < 0.02
    assert 0 < shares[-1] < 0.002


def test_a_start_with_few_beams_claims_what_its_young_map_bears(monkeypatch: pytest.MonkeyPatch):
    """A car in a garage: errors of roll against the first scan are alike from scan to scan."""
    drive = walk(PlatformConfig(scene="garage", platform="car", lidar="vlp-16", seconds=1.6, seed=8522), 0, 14)

    def squared_error_of_turns() -> float:
        estimates = estimated(list(drive))
        pairs = zip(errors_of(estimates, drive.reference), estimates, strict=True)
        return float(np.mean([e[:3] @ np.linalg.solve(one.covariance[:3, :3], e[:3]) / 3 for e, one in pairs]))

    claimed = squared_error_of_turns()
    monkeypatch.setattr(map_errors, "_UNCHANGED_YOUNG_MAP_DRIFT_SHARE", 0.0)
    assert claimed < 0.7 * squared_error_of_turns()


@pytest.mark.parametrize(("lidar", "least", "most"), [("os0", 0.3, 0.7), ("vlp-16", 1.0, 1.0)])
def test_lidars_of_many_beams_claim_about_half(lidar: str, least: float, most: float, monkeypatch: pytest.MonkeyPatch):
    """Planes between the rings of few beams lean, and their points share more of an error."""
    office = walk(PlatformConfig(scene="office", platform="handheld", lidar=lidar, seconds=1.4, seed=8522), 0, 12)

    def claimed() -> float:
        """The mean variance of a step's translation, once the map has a few keyframes."""
        matching = ScanMatching()
        matching.start(office[0])
        guesses = [guess(true_pose(office, k - 1, k), NEAR) for k in range(1, len(office))]
        steps = [matching.refine(office[k], one) for k, one in enumerate(guesses, start=1)]
        return float(np.mean([np.trace(step.covariance[3:, 3:]) for step in steps[3:]]))

    with_share = claimed()
    monkeypatch.setattr(map_errors, "_DENSE_SHARE", 1.0)
    assert least <= with_share / claimed() <= most


# ---------------------------------------------------------------------------------------------------- edges of the map


def test_points_beyond_the_maps_edge_are_left_out_for_lidars_whose_map_has_no_gaps(
    sequence: Sequence, frames: list[Frame]
):
    """Between the rings of a spinning lidar every point is as far from the map's points as beyond an edge."""
    matching = driven(sequence, frames, 1)
    scan = matching.current_scan
    assert scan is not None
    for repeats in (True, False):
        matching.recent.tell(repeats)
        assert matching._problem(scan).without_edges is not repeats


# ---------------------------------------------------------------------------------------------------- where to start


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of starts of each search for a motion."""
    found: list[int] = []
    search = scan_matching.best_start

    def counted(surface, source, points, starts, settings):
        found.append(len(starts))
        return search(surface, source, points, starts, settings)

    monkeypatch.setattr(scan_matching, "best_start", counted)
    return found


@pytest.fixture
def kernels_m(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Width of the kernel with which each registration starts."""
    found: list[float] = []
    register = scan_matching.register_with_degeneracy

    def recorded(problem, initial, kernel_start_m=0.0, is_start_vague=False):
        found.append(kernel_start_m)
        return register(problem, initial, kernel_start_m, is_start_vague)

    monkeypatch.setattr(scan_matching, "register_with_degeneracy", recorded)
    return found


def test_turns_are_searched_only_if_the_rotation_is_unknown(frames: list[Frame], searches: list[int]):
    for initial in (unknown(rotation_rad=0.002), unknown()):
        matching = ScanMatching()
        matching.start(frames[0])
        matching.refine(frames[1], initial)
    speeds, rates = len(ScanMatchingSettings().start_speeds_m_s), len(ScanMatchingSettings().start_rates_deg_s)
    assert searches == [speeds, speeds * rates]


def test_an_unknown_motion_is_continued_where_the_scan_fits_there(
    sequence: Sequence, frames: list[Frame], searches: list[int]
):
    matching = driven(sequence, frames, 3)
    found = matching.refine(frames[4], unknown())
    assert found.ok
    assert searches == []
    assert np.linalg.norm(se3.between(found.pose, true_pose(sequence, 3, 4))[:3, 3]) < 0.05


def test_an_unknown_motion_is_searched_where_the_scan_does_not_fit(
    sequence: Sequence, frames: list[Frame], searches: list[int], rng: np.random.Generator
):
    """Points half a metre off the surfaces have neighbours, but a cost above that of any scan in its place."""
    matching = driven(sequence, frames, 3)
    points = frames[4].scan.points
    matching.refine(with_points(frames[4], points + rng.uniform(-0.7, 0.7, points.shape)), unknown())
    assert len(searches) == 1


@pytest.mark.parametrize(
    ("initial", "least_m", "most_m"),
    [
        (guess(np.eye(4), certain_to(0.0005, 0.001)), 0.05, 0.15),
        (guess(np.eye(4), certain_to(0.03, 0.001)), 0.25, 0.9),
        (guess(np.eye(4), certain_to(0.001, 0.2)), 0.2, 0.5),
        (guess(np.eye(4), certain_to(1.0, 0.2)), 0.9, 1.1),
    ],
    ids=["certain", "uncertain rotation", "uncertain translation", "unknown rotation"],
)
def test_the_kernel_starts_as_wide_as_points_may_be_displaced(
    initial: RelativePose, least_m: float, most_m: float, frames: list[Frame], kernels_m: list[float]
):
    """An uncertain rotation displaces points ten metres away; beyond a metre points are not matched anyway."""
    matching = ScanMatching()
    matching.start(frames[0])
    same = with_points(frames[1], frames[0].scan.points)
    matching.refine(same, initial)
    assert least_m <= kernels_m[0] <= most_m


# ---------------------------------------------------------------------------------------------------- a sparse scan


def test_more_points_of_a_sparse_scan_are_registered_but_not_all(frames: list[Frame]):
    """Voxels shrink until the points stand for enough measured ones, and not much farther."""
    scan, settings = frames[0].scan, replace(ScanMatchingSettings(), least_measured=0)
    few = thin(scan, settings)
    measured_per_point = len(scan) / len(few.points)
    wanted = 1.2 * len(few.source)
    more = thin(scan, replace(settings, least_measured=int(wanted * measured_per_point)))
    assert wanted < 1.1 * len(more.source)
    assert len(more.source) < 0.95 * len(more.points)
