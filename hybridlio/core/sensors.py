"""Sensor data: scans, IMU samples and GPS fixes, and the frame that combines those of one step.

Time is in int64 nanoseconds. Arrays are checked here, when the objects are made, and not again later.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import NS_PER_S as NS_PER_S
from hybridlio.core.arrays import Array, Floats, Index, Mask, Stamps
from hybridlio.core.covariance import check_covariance
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.setting_checks import check_setting

MAX_RANGE_M = 1e4  # several times the range of any lidar; points beyond it are corrupt
# Longest gap between IMU samples to interpolate over: 2.5 scans at 10 Hz. Between samples farther apart a vehicle's
# acceleration and rate can be anything.
LONGEST_INTERPOLATION_NS = 250_000_000


@dataclass(frozen=True, eq=False)
class Scan:
    """One lidar sweep in the lidar frame (x forward, y left, z up).

    Attributes:
        stamp_ns: the time to which motion compensation moves the points.
        points: ``(N, 3)`` float32, metres; rows that are not finite, or 10 km away or more, are dropped.
        intensity: ``(N,)`` float32 reflectance from 0 to 1, or None.
        time_offsets_ns: ``(N,)`` int64, each point's time minus ``stamp_ns``; None if the scan needs no motion
            compensation (KITTI's scans are compensated already).

    Raises:
        DataError: an array has the wrong shape, or times are not integers.
    """

    stamp_ns: int
    points: Floats
    intensity: Floats | None = None
    time_offsets_ns: Stamps | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.stamp_ns, int | np.integer):
            raise DataError(f"scan at {self.stamp_ns!r}: stamp_ns must be an integer number of nanoseconds")
        points = np.ascontiguousarray(self.points, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise DataError(f"scan at {self.stamp_ns} ns: points must be (N, 3), got {points.shape}")
        columns = {"intensity": (self.intensity, np.float32), "time_offsets_ns": (self.time_offsets_ns, np.int64)}
        # almost always; then no array is made or copied. A NaN makes both comparisons false.
        all_valid = not points.size or bool(points.max() < MAX_RANGE_M and points.min() > -MAX_RANGE_M)
        kept = np.ones(len(points), dtype=bool) if all_valid else (np.abs(points) < MAX_RANGE_M).all(axis=1)
        for name, (values, dtype) in columns.items():
            if values is None:
                continue
            if dtype == np.int64 and np.asarray(values).dtype.kind not in "iu":
                raise DataError(f"scan at {self.stamp_ns} ns: {name} must be integer nanoseconds, not float seconds")
            values = np.asarray(values, dtype=dtype)
            if values.shape != points.shape[:1]:
                raise DataError(f"scan at {self.stamp_ns} ns: {name} must be ({len(points)},), got {values.shape}")
            object.__setattr__(self, name, values if all_valid else values[kept])
        object.__setattr__(self, "points", points if all_valid else points[kept])

    def __len__(self) -> int:
        return len(self.points)

    def part(self, rows: Mask | Index) -> Scan:
        """Return the scan with some of its points, by a mask or by their rows."""
        intensity = None if self.intensity is None else self.intensity[rows]
        offsets_ns = None if self.time_offsets_ns is None else self.time_offsets_ns[rows]
        return Scan(self.stamp_ns, self.points[rows], intensity, offsets_ns)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """IMU samples in the IMU frame, strictly increasing in time.

    Attributes:
        stamps_ns: ``(S,)`` int64.
        gyro_rad_s: ``(S, 3)`` angular velocity.
        accel_m_s2: ``(S, 3)`` specific force; at rest +9.81 on the axis that points up.

    Raises:
        DataError: the arrays differ in length, a value is not finite, or time does not increase.
    """

    stamps_ns: Stamps
    gyro_rad_s: Array
    accel_m_s2: Array

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns, dtype=np.int64)
        gyro = np.asarray(self.gyro_rad_s, dtype=np.float64).reshape(-1, 3)
        accel = np.asarray(self.accel_m_s2, dtype=np.float64).reshape(-1, 3)
        if not len(stamps) == len(gyro) == len(accel):
            raise DataError(f"IMU: {len(stamps)} stamps, {len(gyro)} gyro rows, {len(accel)} accelerometer rows")
        bad = ~(np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1))
        if bad.any():
            raise DataError(f"IMU: row {int(bad.argmax())} is not finite; drop or repair it first")
        backwards = np.diff(stamps) <= 0
        if backwards.any():
            raise DataError(f"IMU: time does not increase at row {int(backwards.argmax()) + 1}; sort and deduplicate")
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "gyro_rad_s", gyro)
        object.__setattr__(self, "accel_m_s2", accel)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def empty(cls) -> ImuSamples:
        """Return an object without samples."""
        return cls(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))

    @classmethod
    def concatenate(cls, parts: list[ImuSamples]) -> ImuSamples:
        """Return the samples of consecutive or overlapping intervals in order; equal stamps are kept once."""
        parts = [part for part in parts if len(part)]
        if not parts:
            return cls.empty()
        stamps, first = np.unique(np.concatenate([part.stamps_ns for part in parts]), return_index=True)
        gyro = np.concatenate([part.gyro_rad_s for part in parts])[first]
        accel = np.concatenate([part.accel_m_s2 for part in parts])[first]
        return cls(stamps, gyro, accel)

    def between(self, start_ns: int, end_ns: int) -> ImuSamples:
        """Return the samples from ``start_ns`` to ``end_ns``, with linearly interpolated ones at both ends.

        No sample is interpolated at an end outside the recording or in a gap of more than
        :data:`LONGEST_INTERPOLATION_NS`; the result then starts or stops at a recorded sample. It is empty if
        ``end_ns`` is before ``start_ns``. The search takes logarithmic time in the recording's length.
        """
        if end_ns < start_ns or not len(self):
            return ImuSamples.empty()
        first = int(np.searchsorted(self.stamps_ns, start_ns, side="right"))
        last = int(np.searchsorted(self.stamps_ns, end_ns, side="left"))
        ends = [t for t in (start_ns, end_ns) if self._near_samples(t)]
        stamps = np.unique(np.concatenate([self.stamps_ns[first:last], np.array(ends, np.int64)]))
        if not len(stamps):
            return ImuSamples.empty()
        near = slice(max(first - 1, 0), last + 1)  # one sample beyond each end, to interpolate from
        # times relative to the first: nanoseconds since 1970 exceed the 53 bits of a float64
        at, known = (stamps - stamps[0]) / NS_PER_S, (self.stamps_ns[near] - stamps[0]) / NS_PER_S
        columns = np.hstack([self.gyro_rad_s[near], self.accel_m_s2[near]])
        values = np.column_stack([np.interp(at, known, columns[:, i]) for i in range(6)])
        return ImuSamples(stamps, values[:, :3], values[:, 3:])

    def held_from(self, start_ns: int) -> ImuSamples:
        """Return the samples with the first one held back to a stamp up to :data:`LONGEST_INTERPOLATION_NS` before."""
        if not len(self) or not 0 < self.stamps_ns[0] - start_ns <= LONGEST_INTERPOLATION_NS:
            return self
        first = ImuSamples(np.array([start_ns]), self.gyro_rad_s[:1], self.accel_m_s2[:1])
        return ImuSamples.concatenate([first, self])

    def starts_after(self, stamp_ns: int) -> bool:
        """Return whether the first sample is later than a stamp by more than a period; rates hardly change in one."""
        return len(self) < 2 or bool(self.stamps_ns[0] - stamp_ns > np.median(np.diff(self.stamps_ns)))

    def turns(self, bias_rad_s: Array) -> Array:
        """Return rotation vectors ``(S - 1, 3)`` between samples, rad, by rates without a bias ``(3,)``."""
        return se3.turns_by_rates(self.gyro_rad_s - bias_rad_s, np.diff(self.stamps_ns) / NS_PER_S)

    def orientations(self, bias_rad_s: Array) -> Array:
        """Return rotations ``(S, 3, 3)`` from each sample's frame to the first's, by rates without a bias ``(3,)``."""
        return se3.so3_chain(se3.so3_exp(self.turns(bias_rad_s)))

    def largest_turn_rad(self, bias_rad_s: Array) -> float:
        """Return the largest turn from the first sample to any other: the length of the rates' integral."""
        integral = np.cumsum(self.turns(bias_rad_s), axis=0)
        return float(np.linalg.norm(integral, axis=1).max(initial=0.0))

    def during(self, scan: Scan) -> ImuSamples:
        """Return the samples from the scan's first point to its last; none if the points have no times."""
        if scan.time_offsets_ns is None or not len(scan):
            return ImuSamples.empty()
        first, last = scan.time_offsets_ns.min(), scan.time_offsets_ns.max()
        return self.between(scan.stamp_ns + int(first), scan.stamp_ns + int(last))

    def _near_samples(self, stamp_ns: int) -> bool:
        """Return whether the samples around the stamp are close enough to interpolate between."""
        after = int(np.searchsorted(self.stamps_ns, stamp_ns, side="left"))
        if after == len(self) or (after == 0 and self.stamps_ns[0] != stamp_ns):
            return False
        before = max(after - 1, 0)
        return bool(
            self.stamps_ns[after] == stamp_ns
            or self.stamps_ns[after] - self.stamps_ns[before] <= LONGEST_INTERPOLATION_NS
        )


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise densities of an IMU; the defaults fit MEMS units.

    Names follow the units: ``*_sqrt_hz`` of the measurements is white noise, ``*_walk`` the random walk of the biases,
    and ``*_bias_sigma`` their standard deviation at power-up: 20 to 25 mg and 1 °/s are stated for consumer MEMS units
    (BMI088, LSM6DSO; ICM-20948: 5 °/s), and where it is too small gravity leans by the rest of a bias.
    ``gyro_scale_sigma`` is the relative standard deviation of the gyroscope's sensitivity and of what an axis measures
    of the others: stated tolerances are 0.5 to 1.5 % (ICM-20948, BMI088, LSM6DSO, IAM-20680) and 2 %. A simulated IMU
    may have values of 0; odometry needs all above 0 but this one, 0 for a gyroscope without errors of scale.

    Raises:
        SettingError: a value is negative or not finite.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    gyro_rad_s_sqrt_hz: float = 1.0e-3
    accel_m_s2_sqrt_hz: float = 1.0e-2
    gyro_walk_rad_s2_sqrt_hz: float = 2.0e-5
    accel_walk_m_s3_sqrt_hz: float = 3.0e-4
    gyro_bias_sigma_rad_s: float = 1.7e-2
    accel_bias_sigma_m_s2: float = 2.5e-1
    gyro_scale_sigma: float = 1.0e-2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_setting(self, name, 0 <= value < np.inf, "finite and not negative")


NOISE_DENSITIES = tuple(field.name for field in fields(ImuNoise) if field.name != "gyro_scale_sigma")
"""Values of :class:`ImuNoise` that a graph needs above 0; a scale may be known exactly."""


@dataclass(frozen=True, eq=False)
class GpsFix:
    """One GPS position fix.

    Attributes:
        stamp_ns: time of the fix.
        position_m: ``(3,)`` of the antenna in a local east-north-up frame, common to all fixes of a recording.
        covariance_m2: ``(3, 3)``.
        origin: geodetic position of that frame's origin; None if unknown.

    Raises:
        DataError: the position is not finite, or the covariance not positive definite.
    """

    stamp_ns: int
    position_m: Array
    covariance_m2: Array
    origin: GeodeticPoint | None = None

    def __post_init__(self) -> None:
        name = f"GPS fix at {self.stamp_ns} ns"
        object.__setattr__(self, "position_m", se3.check_position(self.position_m, name))
        object.__setattr__(self, "covariance_m2", check_covariance(self.covariance_m2, name, 3))


@dataclass(frozen=True, eq=False)
class Calibration:
    """The extrinsics: where the sensors are mounted.

    Attributes:
        T_imu_lidar: ``(4, 4)``; maps lidar points into the IMU (body) frame.
        T_camera_lidar: ``(4, 4)`` or None; pose files of KITTI odometry are in this camera's frame.
        antenna_imu_m: ``(3,)`` position of the GPS antenna in the IMU frame; None if unknown, and then taken as zero.

    Raises:
        DataError: a transform is not rigid, or the antenna's position not finite.
    """

    T_imu_lidar: Array = field(default_factory=lambda: np.eye(4))
    T_camera_lidar: Array | None = None
    antenna_imu_m: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_imu_lidar", se3.check_pose(self.T_imu_lidar, "T_imu_lidar"))
        if self.T_camera_lidar is not None:
            object.__setattr__(self, "T_camera_lidar", se3.check_pose(self.T_camera_lidar, "T_camera_lidar"))
        if self.antenna_imu_m is not None:
            object.__setattr__(self, "antenna_imu_m", se3.check_position(self.antenna_imu_m, "antenna_imu_m"))


@dataclass(frozen=True, eq=False)
class Frame:
    """Input of one step: a scan, and the data of IMU and GPS since the scan before.

    Attributes:
        index: position in the recording, from 0.
        scan: the sweep.
        imu: samples from the previous scan's stamp to this one's, interpolated at both; in the first frame those
            before its scan, possibly none.
        gps: fixes in that time.
        sweep_imu: samples during the sweep, for motion compensation; the sweep may end after the scan's stamp. Empty
            if the points of the scan carry no times.
        calibration: the extrinsics; required if there are IMU samples.
        imu_noise: the IMU's noise densities if the recording states them.
    """

    index: int
    scan: Scan
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    gps: tuple[GpsFix, ...] = ()
    sweep_imu: ImuSamples = field(default_factory=ImuSamples.empty)
    calibration: Calibration | None = None
    imu_noise: ImuNoise | None = None
