"""Collects the record of a run step by step; a step takes one or two kilobytes of memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.packed_arrays import PackedArray, pack_arrays, unpack_arrays
from hybridlio.record.record import Record
from hybridlio.record.step_arrays import earlier_scan_arrays, relative_arrays, relative_poses, with_earlier_scans

# Scans that are packed together. As objects they take five times the memory, so few should wait; packing more at once
# only makes the step longer in which it happens.
_PACKED_TOGETHER = 50


class Recorder:
    """Collects a run's estimates, IMU samples and GPS fixes, scan by scan."""

    def __init__(self) -> None:
        self._recent: list[_ScanEstimate] = []
        self._packed: list[dict[str, PackedArray]] = []
        self._imu: list[ImuSamples] = []
        self._gps: list[GpsFix] = []

    def __len__(self) -> int:
        return _PACKED_TOGETHER * len(self._packed) + len(self._recent)

    @property
    def last_ns(self) -> int:
        """Stamp of the last scan; 0 before the first."""
        return self._recent[-1].stamp_ns if self._recent else 0

    def add(
        self,
        stamp_ns: int,
        pose: Array,
        covariance: Array,
        step: tuple[RelativePose, RelativePose] | None = None,
        imu: ImuSamples | None = None,
        gps: tuple[GpsFix, ...] = (),
    ) -> None:
        """Add a scan. After an interrupt (``KeyboardInterrupt``) at any line, the record holds it wholly or not at all.

        Args:
            stamp_ns: the scan's stamp.
            pose: ``(4, 4)`` ``T_world_lidar``.
            covariance: ``(6, 6)`` of the pose.
            step: the initial and the refined relative pose; None for the first scan.
            imu, gps: samples and fixes since the previous scan.
        """
        if len(self._recent) > _PACKED_TOGETHER:
            together = pack_arrays(_arrays(self._recent[:-1]))
            self._packed, self._recent = [*self._packed, together], self._recent[-1:]
        self._imu.append(imu or ImuSamples.empty())
        self._gps.extend(gps)
        self._recent.append(_ScanEstimate(stamp_ns, pose, covariance, step))  # last, because this completes the scan

    def forget(self) -> None:
        """Drop everything but the last scan."""
        self._packed, self._recent, self._imu, self._gps = [], self._recent[-1:], [], []

    def record(
        self,
        start: State,
        calibration: Calibration,
        noise: ImuNoise,
        keyframes: LoopKeyframes,
        scans: int | None = None,
    ) -> Record:
        """Return the record of all scans so far, or of the first ``scans``."""
        parts = [*map(unpack_arrays, self._packed), *([_arrays(self._recent)] if self._recent else [])]
        steps = [step for arrays in parts for step in _steps(arrays)]
        stamps, poses, covariances = (
            np.concatenate([arrays[f"online_{name}"] for arrays in parts])[:scans]
            for name in ("ns", "poses", "covariances")
        )
        steps, last_ns = steps[: len(stamps) - 1], int(stamps[-1])
        return Record(
            online=Trajectory(stamps, poses, covariances),
            initial=tuple(initial for initial, _ in steps),
            relative=tuple(relative for _, relative in steps),
            # an interrupted `add` may have left samples and fixes of the scan after the last
            imu=ImuSamples.concatenate(self._imu).between(start.stamp_ns, last_ns),
            gps=tuple(sorted((f for f in self._gps if f.stamp_ns <= last_ns), key=lambda fix: fix.stamp_ns)),
            start=start,
            calibration=calibration,
            imu_noise=noise,
            keyframes=keyframes.until(len(stamps)),
        )


class _ScanEstimate(NamedTuple):
    """A scan's pose, and the initial and refined relative pose of its step; the first scan has no step."""

    stamp_ns: int
    pose: Array
    covariance: Array
    step: tuple[RelativePose, RelativePose] | None


def _arrays(scans: list[_ScanEstimate]) -> dict[str, Any]:
    initial, relative = (tuple(scan.step[i] for scan in scans if scan.step is not None) for i in (0, 1))
    online = {
        "online_ns": np.array([scan.stamp_ns for scan in scans], np.int64),
        "online_poses": np.array([scan.pose for scan in scans]),
        "online_covariances": np.array([scan.covariance for scan in scans]),
    }
    steps = relative_arrays("initial", initial) | relative_arrays("relative", relative)
    return online | steps | earlier_scan_arrays(relative)


def _steps(arrays: dict[str, Any]) -> Iterator[tuple[RelativePose, RelativePose]]:
    return zip(
        relative_poses("initial", arrays), with_earlier_scans(relative_poses("relative", arrays), arrays), strict=True
    )
