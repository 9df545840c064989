import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.sensors import Scan
from hybridlio.sources.recent_points import RecentPoints, repeats_directions, repeats_rows

HERE = se3.exp(np.array([0.0, 0.1, 0.3, 1.0, -2.0, 0.5]))


def scattered(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points around the lidar in random directions: no two scans have the same."""
    directions = rng.standard_normal((count, 3))
    return 5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def rings(rng: np.random.Generator) -> np.ndarray:
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.4)), np.radians(np.arange(-15, 16, 2.0)))
    directions = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.stack(directions, axis=-1).reshape(-1, 3) * rng.uniform(3, 30)


def recent(scans: list[np.ndarray]) -> RecentPoints:
    out = RecentPoints()
    for k, points in enumerate(scans):
        out.observe(Scan(k, points.astype(np.float32)))
        out.add(points, HERE)
    return out


def test_scans_with_rings_do_not_fill_each_other(rng: np.random.Generator):
    scans = [rings(rng) for _ in range(3)]
    kept = recent(scans)
    assert not kept.is_filling
    assert kept.together(scans[-1], HERE, 0.01) is scans[-1]


@pytest.mark.parametrize("few", [0, 40])
def test_a_scan_of_few_points_decides_nothing_about_the_pattern(rng: np.random.Generator, few: int):
    for kind, repeats in ((rings, True), (scattered, False)):
        scans = [kind(rng) for _ in range(2)]
        assert recent([scans[0], scattered(rng, few), scans[1]]).repeats is repeats


@pytest.mark.parametrize("count", [2, 9, 10, 12])
def test_scattered_scans_fill_each_other_over_a_second(rng: np.random.Generator, count: int):
    scans = [scattered(rng, 500) for _ in range(count)]
    kept = recent(scans)
    assert kept.is_filling == (count < 10)
    expected = np.concatenate(scans[-10:])
    together = kept.together(scans[-1], HERE, 1e-3)  # a voxel for each point
    np.testing.assert_allclose(np.sort(together, axis=0), np.sort(expected, axis=0), atol=2e-3)


def test_earlier_scans_are_moved_to_the_lidar_at_the_last_one(rng: np.random.Generator):
    points, motion = scattered(rng, 500), se3.exp(np.array([0.1, 0.0, 0.2, 0.5, 0.0, 0.0]))
    kept = recent([scattered(rng, 500), points])
    kept.discard_last()
    kept.discard_last()
    kept.add(points, HERE)  # seen again from elsewhere
    again = se3.transform(se3.inverse(motion), points)
    kept.add(again, HERE @ motion)
    together = kept.together(again, HERE @ motion, 0.01)
    assert len(together) < 1.2 * len(points)
    np.testing.assert_allclose(np.sort(together, axis=0)[::50], np.sort(again, axis=0)[::50], atol=0.3)


@pytest.mark.parametrize("count", [100, 300, 1000, 14000])
def test_a_spinning_lidar_repeats_its_rows_however_few_of_its_points_are_left(rng: np.random.Generator, count: int):
    first, second = (Scan(k, rng.choice(rings(rng), count, replace=False).astype(np.float32)) for k in range(2))
    assert repeats_rows(first, second)


@pytest.mark.parametrize("count", [1, 100, 300, 1000, 20000])
def test_scattered_scans_repeat_nothing_however_many_points_they_have(rng: np.random.Generator, count: int):
    first, second = (Scan(k, scattered(rng, count).astype(np.float32)) for k in range(2))
    assert not repeats_directions(first, second)
    assert not repeats_rows(first, second)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_spinning_lidar_repeats_its_rows_among_points_that_are_anywhere(rng: np.random.Generator, share: float):
    first, second = rings(rng), rings(rng)
    wrong = rng.random(len(second)) < share
    second[wrong] = scattered(rng, int(wrong.sum()))
    assert repeats_rows(Scan(0, first.astype(np.float32)), Scan(1, second.astype(np.float32)))


@pytest.mark.parametrize(("count", "azimuth_deg", "elevations_deg"), [(24_000, 70, (-35, 35)), (20_000, 360, (-7, 52))])
def test_scans_that_have_a_point_in_every_degree_by_chance_repeat_nothing(
    rng: np.random.Generator, count: int, azimuth_deg: float, elevations_deg: tuple[float, float]
):
    """By data sheets: the Avia measures 24,000 points a scan within 70°, the Mid-360 20,000 within 360° × 59°."""
    first, second = (
        along(
            np.radians(rng.uniform(-azimuth_deg / 2, azimuth_deg / 2, count)),
            np.radians(rng.uniform(*elevations_deg, count)),
        )
        for _ in range(2)
    )
    assert not repeats_directions(first, second)
    assert not repeats_rows(first, second)


@pytest.mark.parametrize("columns", [1024, 1800])
def test_a_spinning_lidar_repeats_its_directions_though_its_turns_start_anywhere(
    rng: np.random.Generator, columns: int
):
    azimuth, elevation = np.meshgrid(2 * np.pi * np.arange(columns) / columns, np.radians(np.arange(-15, 16, 2.0)))
    first, second = (along(azimuth.ravel() + rng.uniform(0, 2 * np.pi / columns), elevation.ravel()) for _ in range(2))
    assert repeats_directions(first, second)


@pytest.mark.parametrize("repeats", [True, False])
def test_what_is_told_of_the_pattern_holds_whatever_scans_come(rng: np.random.Generator, repeats: bool):
    told = RecentPoints()
    told.tell(repeats)
    told = told.emptied()
    for k in range(2):
        told.observe(Scan(k, (scattered(rng) if repeats else rings(rng)).astype(np.float32)))
    assert told.repeats == repeats


def along(azimuth: np.ndarray, elevation: np.ndarray) -> Scan:
    """A scan in directions, radians."""
    level = np.cos(elevation)
    points = 5 * np.c_[level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return Scan(0, points.astype(np.float32), time_offsets_ns=np.zeros(len(points), np.int64))
