"""Points that are no returns, whole millimetres, and intensities."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_files import read_scan
from hybridlio.datasets.points.point_format import PointFormat, find_format, sampled


def directions(count: int, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.4, 0.3, count)
    flat = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)[:, None]
    return np.column_stack([flat, np.sin(elevation)])


def columns_of(points: NDArray[Any], **extra: NDArray[Any]) -> dict[str, NDArray[Any]]:
    return {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], **extra}


def cloud(seed: int, count: int = 2000) -> NDArray[np.float64]:
    return directions(count, seed) * np.random.default_rng(seed).uniform(2, 60, (count, 1))


@pytest.mark.parametrize("code_m", [65.535, 120.0, 200.0, 655.35])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.9])
@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_a_code_of_no_returns_at_one_range_is_found_noted_and_left_out(code_m: float, share: float, dtype: str) -> None:
    samples = []
    for k in range(5):
        points = cloud(k)
        points[: int(share * len(points))] = directions(int(share * len(points)), 9) * code_m
        samples.append((k, columns_of(points.astype(dtype), t=np.arange(len(points)) * 50_000)))
    notes = Notes("ride")
    found = find_format(samples, 100_000_000, notes)
    scan = found.scan(samples[3][1], 3)
    assert len(scan) == len(scan.time_offsets_ns) == 2000 - int(share * 2000)
    np.testing.assert_array_equal(scan.points, cloud(3)[int(share * 2000) :].astype(dtype).astype("f4"))
    assert f"points at exactly {code_m:.3f} m" in notes.texts[0]


@pytest.mark.parametrize("scene", ["far wall", "ring on flat ground", "few far points", "in one scan of five"])
def test_real_surfaces_are_no_codes(scene: str) -> None:
    samples = []
    for k in range(5):
        points = cloud(k)
        if scene == "far wall":
            points[:400] = directions(400, k) * 70
            points[:400, 0] = 70.0  # equal distance along x, not equal range
        elif scene == "ring on flat ground":
            azimuth = np.linspace(0, 6, 400)
            points[:400] = 80 * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(400, -0.02)])
        elif scene == "few far points":
            points[:5] = directions(5) * 90
        elif k == 2:
            points[:400] = directions(400) * 90
        samples.append((k, columns_of(points)))
    assert find_format(samples, 100_000_000, Notes("ride")).no_return_m is None


def test_points_at_the_origin_are_left_out_with_their_times_and_noted() -> None:
    points, times = cloud(1), np.arange(2000) * 50_000
    points[::4] = 0
    times[::4] = 0  # as drivers write them; they must not change the times' meaning
    notes = Notes("ride")
    found = find_format([(0, columns_of(points, t=times))], 100_000_000, notes)
    scan = found.scan(columns_of(points, t=times), 0)
    assert len(scan) == 1500
    np.testing.assert_array_equal(scan.time_offsets_ns, np.delete(times, np.s_[::4]))
    assert "points at the origin, 25.0% of a scan" in notes.texts[0]


def test_times_of_points_that_are_not_finite_need_not_be_finite() -> None:
    points, times = cloud(1), np.linspace(0, 0.0999, 2000)
    points[::4], times[::4] = np.nan, np.nan
    found = find_format([(0, columns_of(points, t=times))], 100_000_000, Notes("ride"))
    assert len(found.scan(columns_of(points, t=times), 0).time_offsets_ns) == 1500


@pytest.mark.parametrize("dtype", ["<i2", "<i4", "<i8", "<f4"])
def test_whole_millimetres_are_read_as_metres_and_noted(dtype: str) -> None:
    points = (cloud(2) / 3 * 1000).round().astype(dtype)
    notes = Notes("ride")
    found = find_format([(0, columns_of(points))], None, notes)
    np.testing.assert_allclose(found.scan(columns_of(points), 0).points, cloud(2) / 3, atol=6e-4)
    assert "read as millimetres" in notes.texts[0]


def test_whole_metres_stay_metres() -> None:
    points = cloud(2).round()
    assert find_format([(0, columns_of(points))], None, Notes("ride")).scale_m == 1.0


@pytest.mark.parametrize(("largest", "scale"), [(1.0, 1), (255.0, 255), (65535.0, 65535), (4000.0, 65535), (0.0, 1)])
def test_intensities_are_scaled_to_one(largest: float, scale: float) -> None:
    scan = PointFormat().scan(columns_of(cloud(0), remission=np.linspace(0, largest, 2000)), 0)
    np.testing.assert_allclose(scan.intensity, np.linspace(0, largest / scale, 2000), atol=1e-6)


def test_points_in_a_maps_frame_are_refused_with_the_cause() -> None:
    columns = columns_of(cloud(0) + np.array([500_000, 5_400_000, 100]))
    with pytest.raises(DataError, match="over 10 km away, as in a map's frame"):
        PointFormat().scan(columns, 0)
    with pytest.raises(DataError, match="expected fields x y z, found x"):
        PointFormat().scan({"x": np.zeros(3)}, 0)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 6, 1000])
def test_sampled_scans_are_spread_over_the_recording(count: int) -> None:
    assert len(sampled(count)) == min(count, 5)
    assert set(sampled(count)) <= set(range(count))


def test_livox_times_of_the_known_file_stay_within_its_sweep(cases: Path) -> None:
    scan = read_scan(cases / "livox_float64_ns.pcd", 1_700_000_000_000_000_000)
    assert len(scan) == 2000
    assert 0 <= scan.time_offsets_ns.min() < scan.time_offsets_ns.max() <= 100_000_000
