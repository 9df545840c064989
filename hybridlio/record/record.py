"""The record of a run for smoothing: relative poses of every step, inertial samples, GPS fixes and the initial state.

A record comes from a run of :class:`~hybridlio.odometry.odometry.Odometry`, from a file, or from the poses of another
odometry (:meth:`Record.from_odometry`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.files import UNREADABLE_NPZ, atomic_path, opened_npz
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.sensors import NS_PER_S, Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.imu_clock import on_poses_clock
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.odometry_noise import odometry_noise
from hybridlio.record.step_arrays import earlier_scan_arrays, relative_arrays, relative_poses, with_earlier_scans

FORMAT_VERSION = 2  # stored in the file
_READABLE = (1, 2)  # version 1 has no poses relative to earlier scans
_SOURCE = "odometry"  # `source` of the steps of an odometry that is not ours
_FIRST_POSE_VARIANCE = 1e-12  # rad², m²; the first pose is the origin, but a covariance must be positive definite


@dataclass(frozen=True, eq=False)
class Record:
    """A run, ready to be smoothed.

    Attributes:
        online: the backend's estimate at each of ``N`` scans, with covariances.
        initial: ``N-1`` initial relative poses ``T_k_k1``, lidar frames.
        relative: ``N-1`` relative poses ``T_k_k1`` after the residual source, lidar frames.
        imu: all samples from the first scan to the last; empty without an IMU.
        gps: the fixes from the first scan to the last, in order of time.
        start: the prior state at the first scan.
        calibration: the extrinsics.
        imu_noise: the noise densities that the run assumed.
        keyframes: clouds for loop closure, or None; they are stored in a separate file.
        imu_time_offset_s: seconds that were added to the samples' stamps to bring them to the poses' clock.
        notes: what was corrected in the data, and what is doubtful.
    """

    online: Trajectory
    initial: tuple[RelativePose, ...]
    relative: tuple[RelativePose, ...]
    imu: ImuSamples
    gps: tuple[GpsFix, ...]
    start: State
    calibration: Calibration
    imu_noise: ImuNoise
    keyframes: LoopKeyframes | None = None
    imu_time_offset_s: float = 0.0
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        keyframes = "no" if self.keyframes is None else len(self.keyframes)
        return (
            f"Record({len(self.online)} scans, {self.online.length_m:.1f} m, {len(self.imu.stamps_ns)} IMU samples, "
            f"{len(self.gps)} GPS fixes, {keyframes} loop keyframes)"
        )

    @classmethod
    def from_odometry(
        cls,
        trajectory: Trajectory,
        imu: ImuSamples | None = None,
        gps: tuple[GpsFix, ...] = (),
        calibration: Calibration | None = None,
        imu_noise: ImuNoise | None = None,
        covariances: ArrayLike | None = None,
        imu_time_offset_s: float | None = None,
    ) -> Record:
        """Make a record from the poses of another odometry, to smooth them together with IMU samples and GPS fixes.

        Args:
            trajectory: ``N`` lidar poses, at least two, in any world frame.
            imu: the samples.
            gps: fixes; their clock may differ by a constant.
            calibration: the extrinsics; by default the IMU frame is the lidar frame.
            imu_noise: the IMU's noise densities; by default those of a MEMS unit.
            covariances: ``(N-1, 6, 6)`` of the steps between consecutive poses, or one ``(6, 6)`` for all, rad² and m²,
                rotation first. Errors of different steps must be independent. By default they are estimated from the
                differences between poses and IMU (:func:`hybridlio.record.odometry_noise.odometry_noise`).
            imu_time_offset_s: seconds to add to the IMU's stamps to bring them to the poses' clock. By default an
                offset within ±5 s is found from the rotations, applied where it is significant, and noted
                (:mod:`hybridlio.record.imu_clock`).

        Raises:
            DataError: fewer than two poses, or covariances of another shape or not positive definite.
        """
        if len(trajectory) < 2:
            raise DataError(f"a record needs at least two poses, got {len(trajectory)}")
        trajectory = trajectory.from_first()
        calibration, imu_noise = calibration or Calibration(), imu_noise or ImuNoise()
        on_clock = on_poses_clock(trajectory, imu or ImuSamples.empty(), calibration, imu_time_offset_s)
        imu = on_clock.imu
        steps = _steps_of(trajectory, on_clock.agreeing or imu, calibration, covariances)
        start_ns, end_ns = (int(stamp) for stamp in trajectory.stamps_ns[[0, -1]])
        inside = imu.between(start_ns, end_ns)
        first = inside.stamps_ns <= inside.stamps_ns[0] + NS_PER_S if len(inside) else np.zeros(0, bool)
        beginning = ImuSamples(inside.stamps_ns[first], inside.gyro_rad_s[first], inside.accel_m_s2[first])
        return cls(
            online=Trajectory(trajectory.stamps_ns, trajectory.poses, _accumulated(steps)),
            initial=steps,
            relative=steps,
            imu=inside,
            gps=tuple(sorted(gps or (), key=lambda fix: fix.stamp_ns)),
            start=start_state(start_ns, beginning, imu_noise),
            calibration=calibration,
            imu_noise=imu_noise,
            imu_time_offset_s=on_clock.offset_s,
            notes=on_clock.notes,
        )

    @property
    def origin(self) -> GeodeticPoint | None:
        """Geodetic position of the origin of the fixes' frame; None without fixes, or when they do not give it."""
        return self.gps[0].origin if self.gps else None

    @property
    def edges(self) -> list[tuple[int, int, RelativePose]]:
        """Every measured relative pose as ``(i, j, T_i_j)``, scans by number, with its full covariance.

        A plain pose graph takes these edges for independent. They are not: poses of one scan relative to several
        others share that scan's scatter. :func:`hybridlio.graph.run.smooth.smooth` models this.
        """
        number = {int(stamp): k for k, stamp in enumerate(self.online.stamps_ns)}
        out = []
        for k, step in enumerate(self.relative):
            out.append((k, k + 1, step))
            scatter = 0 if step.drift is None or not step.ok else step.covariance - step.drift
            for near in step.earlier_scans:
                edge = RelativePose(near.pose, near.covariance + scatter, step.source)
                out.append((number[near.stamp_ns], k + 1, edge))
        return out

    def save(self, path: Path) -> None:
        """Write everything except ``keyframes`` to one ``.npz`` file of plain arrays."""
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **_to_arrays(self))

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a record written by :meth:`save`; never executes anything in the file.

        Raises:
            DataError: the file is missing, is not a record, or has a newer format version.
        """
        try:
            with opened_npz(path) as file:
                return _from_arrays({name: file[name] for name in file.files})
        except UNREADABLE_NPZ as error:
            raise DataError(f"{path}: not the record of a run ({error}); run `hybridlio odometry` again") from error


def _steps_of(
    trajectory: Trajectory, imu: ImuSamples, calibration: Calibration, covariances: ArrayLike | None
) -> tuple[RelativePose, ...]:
    """Return the relative poses between consecutive poses, with the given covariances or those found from the IMU."""
    poses = se3.between(trajectory.poses[:-1], trajectory.poses[1:])
    if covariances is not None:
        given = _each(covariances, len(poses))
        return tuple(RelativePose(T, c, _SOURCE) for T, c in zip(poses, given, strict=True))
    noise = odometry_noise(trajectory, imu, calibration)
    columns = zip(poses, noise.covariances, noise.drifts, strict=True)
    return tuple(RelativePose(T, covariance, _SOURCE, drift=drift) for T, covariance, drift in columns)


def _each(covariances: ArrayLike, steps: int) -> Array:
    """Return the steps' covariances ``(steps, 6, 6)`` from one ``(6, 6)`` for all, or one for each."""
    given = np.asarray(covariances, dtype=np.float64)
    given = np.broadcast_to(given, (steps, 6, 6)) if given.shape == (6, 6) else given
    if given.shape != (steps, 6, 6):
        raise DataError(
            f"step covariances: expected shape (6, 6), or ({steps}, 6, 6) for {steps + 1} poses, got {given.shape}"
        )
    return given


def _accumulated(steps: tuple[RelativePose, ...]) -> Array:
    """Return the covariances ``(N, 6, 6)`` of the poses: the steps' drift added up from the first pose on."""
    out = [np.eye(6) * _FIRST_POSE_VARIANCE]
    for step in steps:
        added = step.covariance if step.drift is None else step.drift
        out.append(se3.compose_covariance(out[-1], step.pose, added))
    return np.array(out)


def _to_arrays(record: Record) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "version": FORMAT_VERSION,
        "stamps_ns": record.online.stamps_ns,
        "online_poses": record.online.poses,
        "online_covariances": record.online.covariances,
        "imu_stamps_ns": record.imu.stamps_ns,
        "gyro_rad_s": record.imu.gyro_rad_s,
        "accel_m_s2": record.imu.accel_m_s2,
        "gps_stamps_ns": np.array([fix.stamp_ns for fix in record.gps], dtype=np.int64),
        "gps_positions_m": np.array([fix.position_m for fix in record.gps]).reshape(-1, 3),
        "gps_covariances_m2": np.array([fix.covariance_m2 for fix in record.gps]).reshape(-1, 3, 3),
        "T_imu_lidar": record.calibration.T_imu_lidar,
        "imu_noise": np.array(list(asdict(record.imu_noise).values())),
        "imu_time_offset_s": record.imu_time_offset_s,
        "notes": np.array(record.notes, dtype=np.str_),
    }
    if record.calibration.T_camera_lidar is not None:
        arrays["T_camera_lidar"] = record.calibration.T_camera_lidar
    if record.calibration.antenna_imu_m is not None:
        arrays["antenna_imu_m"] = record.calibration.antenna_imu_m
    if record.origin is not None:
        arrays["gps_origin"] = np.array(record.origin)
    arrays |= {f"start_{f.name}": getattr(record.start, f.name) for f in fields(State)}
    steps = relative_arrays("initial", record.initial) | relative_arrays("relative", record.relative)
    return arrays | steps | earlier_scan_arrays(record.relative)


def _from_arrays(arrays: Mapping[str, Any]) -> Record:
    if int(arrays["version"]) not in _READABLE:
        raise ValueError(f"format version {int(arrays['version'])}, this release reads {FORMAT_VERSION} and older")
    start = {f.name: arrays[f"start_{f.name}"] for f in fields(State)}
    start |= {"stamp_ns": int(start["stamp_ns"]), "has_imu": bool(start["has_imu"])}
    origin = GeodeticPoint(*arrays["gps_origin"].tolist()) if "gps_origin" in arrays else None
    gps = zip(arrays["gps_stamps_ns"], arrays["gps_positions_m"], arrays["gps_covariances_m2"], strict=True)
    return Record(
        online=Trajectory(arrays["stamps_ns"], arrays["online_poses"], arrays["online_covariances"]),
        initial=relative_poses("initial", arrays),
        relative=with_earlier_scans(relative_poses("relative", arrays), arrays),
        imu=ImuSamples(arrays["imu_stamps_ns"], arrays["gyro_rad_s"], arrays["accel_m_s2"]),
        gps=tuple(GpsFix(int(stamp), position, covariance, origin) for stamp, position, covariance in gps),
        start=State(**start),
        calibration=Calibration(arrays["T_imu_lidar"], arrays.get("T_camera_lidar"), arrays.get("antenna_imu_m")),
        imu_noise=ImuNoise(*map(float, arrays["imu_noise"])),
        imu_time_offset_s=float(arrays.get("imu_time_offset_s", 0.0)),  # records of earlier releases have neither
        notes=tuple(map(str, arrays.get("notes", ()))),
    )
