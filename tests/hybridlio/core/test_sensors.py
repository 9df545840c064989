"""Sensor data: properties of time slices, and checks of values on construction."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import trapezoid

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.core.sensors import Calibration, GpsFix, ImuSamples, Scan

START_NS = 1_317_042_272_335_337_762  # nanoseconds since 1970 exceed the precision of a float64
MS = 1_000_000


def recording(count: int = 200, seed: int = 0) -> ImuSamples:
    """100 Hz with jitter."""
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.arange(count) * 10 * MS + rng.integers(-3 * MS, 3 * MS, count)
    return ImuSamples(stamps, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))


def between_by_definition(imu: ImuSamples, start: int, end: int) -> tuple[list[int], np.ndarray]:
    """Return the samples inside and the interpolated ends by a linear search in exact integers."""
    stamps = imu.stamps_ns.tolist()
    wanted = {t for t in stamps if start < t < end} | {t for t in (start, end) if stamps[0] <= t <= stamps[-1]}
    values = []
    for t in sorted(wanted):
        k = next(i for i, s in enumerate(stamps) if s >= t)
        part = 0.0 if stamps[k] == t else (stamps[k] - t) / (stamps[k] - stamps[k - 1])
        row = np.hstack([imu.gyro_rad_s, imu.accel_m_s2])
        values.append((1 - part) * row[k] + part * row[k - (1 if part else 0)])
    return sorted(wanted), np.array(values).reshape(-1, 6)


class TestImuSamplesBetween:
    def test_a_slice_equals_its_definition_for_any_ends(self, rng: np.random.Generator) -> None:
        imu = recording(40)
        edges = np.concatenate([imu.stamps_ns[[0, 1, 7, 38, 39]], START_NS + rng.integers(-30 * MS, 430 * MS, 15)])
        for start in edges.tolist():
            for end in edges[edges >= start].tolist():
                stamps, values = between_by_definition(imu, start, end)
                got = imu.between(start, end)
                assert got.stamps_ns.tolist() == stamps
                np.testing.assert_allclose(np.hstack([got.gyro_rad_s, got.accel_m_s2]), values, atol=1e-9)

    def test_neighbouring_slices_share_their_end_and_cover_all_samples(self) -> None:
        imu = recording()
        cuts = START_NS + np.array([50, 153, 153 + 7, 900, 1500]) * MS
        parts = [imu.between(int(a), int(b)) for a, b in pairwise(cuts)]
        for left, right in pairwise(parts):
            assert left.stamps_ns[-1] == right.stamps_ns[0]
            np.testing.assert_allclose(left.accel_m_s2[-1], right.accel_m_s2[0], atol=1e-12)
        inside = set(np.concatenate([p.stamps_ns for p in parts]).tolist()) - set(cuts.tolist())
        whole = imu.stamps_ns[(imu.stamps_ns > cuts[0]) & (imu.stamps_ns < cuts[-1])]
        assert inside == set(whole.tolist()) - set(cuts.tolist())

    def test_slices_keep_the_integral_of_a_piecewise_linear_signal(self) -> None:
        imu = recording()
        a, b, c = (START_NS + ms * MS for ms in (101, 555, 1203))

        def integral(samples: ImuSamples) -> np.ndarray:
            return trapezoid(samples.gyro_rad_s, (samples.stamps_ns - START_NS) / 1e9, axis=0)

        parts = integral(imu.between(a, b)) + integral(imu.between(b, c))
        np.testing.assert_allclose(parts, integral(imu.between(a, c)), atol=1e-12)

    def test_slices_do_not_extrapolate(self) -> None:
        imu = recording()
        first, last = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
        assert imu.between(first - 10**9, first + 50 * MS).stamps_ns[0] == first
        assert imu.between(last - 50 * MS, last + 10**9).stamps_ns[-1] == last
        assert len(imu.between(first - 10**9, first - 1)) == 0
        assert len(imu.between(last + 1, last + 10**9)) == 0

    def test_a_slice_is_empty_without_samples_or_if_it_ends_before_its_start(self) -> None:
        assert len(ImuSamples.empty().between(0, 10)) == 0
        assert len(recording().between(START_NS + 500 * MS, START_NS + 400 * MS)) == 0


@pytest.mark.parametrize(
    ("stamps", "gyro", "accel", "says"),
    [
        ([0, 10, 10], np.zeros((3, 3)), np.zeros((3, 3)), "row 2"),
        ([0, 10, 5], np.zeros((3, 3)), np.zeros((3, 3)), "row 2"),
        ([0, 10], np.zeros((3, 3)), np.zeros((3, 3)), "2 stamps"),
        ([0, 10], [[0, 0, 0], [0, np.nan, 0]], np.zeros((2, 3)), "row 1"),
        ([0, 10], np.zeros((2, 3)), [[np.inf, 0, 0], [0, 0, 0]], "row 0"),
    ],
    ids=["repeated", "backwards", "lengths", "gyro not finite", "accel not finite"],
)
def test_bad_imu_samples_are_refused_with_the_row(stamps: list[int], gyro: object, accel: object, says: str) -> None:
    with pytest.raises(DataError, match=says):
        ImuSamples(np.array(stamps), np.asarray(gyro), np.asarray(accel))


@pytest.mark.parametrize("broken", [np.inf, 1e30, -1e4])
def test_a_scan_drops_invalid_points_with_their_intensity_and_time(broken: float) -> None:
    points = np.arange(12.0).reshape(4, 3)
    points[1, 2], points[3, 0] = np.nan, broken
    scan = Scan(7, points, intensity=np.arange(4.0), time_offsets_ns=np.arange(4) * 100)
    assert scan.points.tolist() == [[0, 1, 2], [6, 7, 8]]
    assert scan.intensity is not None
    assert scan.time_offsets_ns is not None
    assert scan.intensity.tolist() == [0, 2]
    assert scan.time_offsets_ns.tolist() == [0, 200]
    assert (scan.points.dtype, scan.intensity.dtype, scan.time_offsets_ns.dtype) == (np.float32, np.float32, np.int64)


@pytest.mark.parametrize(
    "wrong",
    [
        {"points": np.zeros((5, 4))},
        {"points": np.zeros(3)},
        {"points": np.zeros((5, 3)), "intensity": np.zeros(4)},
        {"points": np.zeros((5, 3)), "time_offsets_ns": np.zeros(6)},
    ],
    ids=["columns", "dimensions", "intensity", "times"],
)
def test_scans_of_wrong_shapes_are_refused_with_their_stamp(wrong: dict[str, np.ndarray]) -> None:
    with pytest.raises(DataError, match="123 ns"):
        Scan(123, **wrong)  # type: ignore[arg-type]


def test_calibration_accepts_rounded_extrinsics_and_refuses_others() -> None:
    T = se3.exp([0.01, -0.02, 1.5, 0.8, -0.3, 0.8])
    calibration = Calibration(np.round(T, 6), np.round(se3.inverse(T), 6))
    np.testing.assert_allclose(calibration.T_imu_lidar, T, atol=1e-5)
    R = calibration.T_imu_lidar[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    for name in ("T_imu_lidar", "T_camera_lidar"):
        with pytest.raises(DataError, match=name):
            Calibration(**{name: np.diag([1.0, 1.0, -1.0, 1.0])})


@pytest.mark.parametrize(
    ("position", "covariance", "says"),
    [
        ([0.0, np.nan, 0.0], np.eye(3), "three finite coordinates"),
        ([0.0, 0.0], np.eye(3), "three finite coordinates"),
        ([0.0, 0.0, 0.0], np.eye(2), "covariance"),
        ([0.0, 0.0, 0.0], np.diag([1.0, 1.0, 0.0]), "covariance"),
        ([0.0, 0.0, 0.0], np.full((3, 3), np.inf), "covariance"),
    ],
)
def test_an_invalid_fix_is_refused_with_its_stamp(position, covariance, says) -> None:
    with pytest.raises(DataError, match=f"GPS fix at 7 ns.*{says}"):
        GpsFix(7, np.array(position), covariance)


@pytest.mark.parametrize("has_columns", [True, False])
def test_a_part_of_a_scan_keeps_what_belongs_to_its_points(has_columns: bool) -> None:
    rng, count = np.random.default_rng(5), 40
    intensity, offsets = (rng.random(count), rng.integers(0, 10**8, count)) if has_columns else (None, None)
    scan = Scan(7, rng.normal(size=(count, 3)), intensity, offsets)
    mask = rng.random(count) < 0.5
    for part in (scan.part(mask), scan.part(np.flatnonzero(mask))):
        assert part.stamp_ns == 7
        for name in ("points", "intensity", "time_offsets_ns"):
            whole, kept = getattr(scan, name), getattr(part, name)
            assert (kept is None) if whole is None else (kept == whole[mask]).all()


@pytest.mark.parametrize("name", list(LIDAR_MODELS))
def test_beams_of_each_lidar_go_from_the_top_down(name: str) -> None:
    model = LIDAR_MODELS[name]
    assert model.name == name
    assert model.beams == {"hdl-64e": 64, "32-beam": 32, "16-beam": 16}[name]
    assert (np.diff(model.elevations_deg) < 0).all()


@pytest.mark.parametrize(
    ("stamp", "offsets", "says"),
    [
        (1.5, None, "integer number of nano"),
        ("1", None, "integer number"),
        (1, [0.0, 0.05], "integer nanoseconds"),
    ],
)
def test_times_in_seconds_are_refused(stamp, offsets, says) -> None:
    with pytest.raises(DataError, match=says):
        Scan(stamp, np.zeros((2, 3), np.float32), time_offsets_ns=None if offsets is None else np.array(offsets))
