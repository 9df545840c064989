"""Makes the record of a run while it goes on: a kilobyte or two a step, most of it packed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.packed_arrays import PackedArray, packed, unpacked
from hybridlio.core.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.record.step_arrays import keyframe_arrays, relative_arrays, relatives, with_keyframes

_AT_ONCE = 50  # so many scans are packed together: as objects they take five times the memory


class Recorder:
    """Takes in a run's estimates, samples and fixes."""

    def __init__(self) -> None:
        self._recent: list[_Kept] = []
        self._packed: list[dict[str, PackedArray]] = []
        self._imu: list[ImuSamples] = []
        self._gps: list[GpsFix] = []

    def __len__(self) -> int:
        return _AT_ONCE * len(self._packed) + len(self._recent)

    @property
    def last_ns(self) -> int:
        """The last scan's stamp; 0 before the first."""
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
        """Take in a scan's estimate, or where that is interrupted nothing that :meth:`record` would tell.

        Args:
            stamp_ns: the scan's stamp.
            pose, covariance: of the scan.
            step: the initial and the refined relative pose; the first scan has none.
            imu, gps: samples and fixes since the scan before.
        """
        if len(self._recent) > _AT_ONCE:
            together = packed(_arrays(self._recent[:-1]))
            self._packed, self._recent = [*self._packed, together], self._recent[-1:]
        self._imu.append(imu or ImuSamples.empty())
        self._gps.extend(gps)
        self._recent.append(_Kept(stamp_ns, pose, covariance, step))  # last: with it the scan is there

    def record(
        self,
        start: State,
        calibration: Calibration,
        noise: ImuNoise,
        keyframes: LoopKeyframes,
        scans: int | None = None,
    ) -> Record:
        """All so far, or the first ``scans`` of it."""
        parts = [*map(unpacked, self._packed), *([_arrays(self._recent)] if self._recent else [])]
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
            # an interrupt may have left more
            imu=concatenate_imu(self._imu).between(start.stamp_ns, last_ns),
            gps=tuple(fix for fix in self._gps if fix.stamp_ns <= last_ns),
            start=start,
            calibration=calibration,
            imu_noise=noise,
            keyframes=keyframes.until(len(stamps)),
        )


class _Kept(NamedTuple):
    """A scan's estimate, and its initial and refined relative poses but for the first."""

    stamp_ns: int
    pose: Array
    covariance: Array
    step: tuple[RelativePose, RelativePose] | None


def _arrays(scans: list[_Kept]) -> dict[str, Any]:
    initial, relative = (tuple(scan.step[i] for scan in scans if scan.step is not None) for i in (0, 1))
    online = {
        "online_ns": np.array([scan.stamp_ns for scan in scans], np.int64),
        "online_poses": np.array([scan.pose for scan in scans]),
        "online_covariances": np.array([scan.covariance for scan in scans]),
    }
    return (
        online | relative_arrays("initial", initial) | relative_arrays("relative", relative) | keyframe_arrays(relative)
    )


def _steps(arrays: dict[str, Any]) -> Iterator[tuple[RelativePose, RelativePose]]:
    return zip(relatives("initial", arrays), with_keyframes(relatives("relative", arrays), arrays), strict=True)


def concatenate_imu(parts: list[ImuSamples]) -> ImuSamples:
    """Samples of consecutive intervals as one; those on a common border once."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return ImuSamples.empty()
    stamps, first = np.unique(np.concatenate([part.stamps_ns for part in parts]), return_index=True)
    gyro = np.concatenate([part.gyro_rad_s for part in parts])[first]
    accel = np.concatenate([part.accel_m_s2 for part in parts])[first]
    return ImuSamples(stamps, gyro, accel)
