"""Makes the record of a run while it goes on: a few kilobytes a step, most of it as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from hybridlio.estimates import Array, RelativePose, State
from hybridlio.keyframes import Keyframes
from hybridlio.record import Record
from hybridlio.record_steps import keyframe_arrays, relative_arrays, relatives, with_keyframes
from hybridlio.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.trajectory import Trajectory

_AT_ONCE = 100  # so many steps become arrays together: as objects they take five times the memory


class RecordMaker:
    """Takes in a run's estimates, samples and fixes."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._poses: list[Array] = []
        self._covariances: list[Array] = []
        self._steps: list[tuple[RelativePose, RelativePose]] = []
        self._packed: list[dict[str, Any]] = []
        self._imu: list[ImuSamples] = []
        self._gps: list[GpsFix] = []

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def last_ns(self) -> int:
        """The last scan's stamp."""
        return self._stamps_ns[-1]

    def heard(self, gps: tuple[GpsFix, ...]) -> None:
        """Take in fixes."""
        self._gps.extend(gps)

    def felt(self, imu: ImuSamples) -> None:
        """Take in inertial samples."""
        self._imu.append(imu)

    def add(
        self, stamp_ns: int, pose: Array, covariance: Array, step: tuple[RelativePose, RelativePose] | None = None
    ) -> None:
        """Take in a scan's estimate, and but for the first scan the initial and the refined relative pose."""
        self._stamps_ns.append(stamp_ns)
        self._poses.append(pose)
        self._covariances.append(covariance)
        if step is not None:
            self._steps.append(step)
        if len(self._steps) >= _AT_ONCE:
            initial, relative = zip(*self._steps, strict=True)
            self._packed.append(
                relative_arrays("initial", initial) | relative_arrays("relative", relative) | keyframe_arrays(relative)
            )
            self._steps = []

    def record(self, start: State, calibration: Calibration, noise: ImuNoise, keyframes: Keyframes) -> Record:
        """All so far."""
        stamps = np.array(self._stamps_ns)
        steps = [step for arrays in self._packed for step in _steps(arrays)] + self._steps
        return Record(
            online=Trajectory(stamps, np.array(self._poses), np.array(self._covariances)),
            initial=tuple(initial for initial, _ in steps),
            relative=tuple(relative for _, relative in steps),
            # a step that failed or was interrupted may have added more
            imu=joined(self._imu).between(start.stamp_ns, int(stamps[-1])),
            gps=tuple(fix for fix in self._gps if fix.stamp_ns <= stamps[-1]),
            start=start,
            calibration=calibration,
            imu_noise=noise,
            keyframes=keyframes,
        )


def _steps(arrays: dict[str, Any]) -> Iterator[tuple[RelativePose, RelativePose]]:
    return zip(relatives("initial", arrays), with_keyframes(relatives("relative", arrays), arrays), strict=True)


def joined(parts: list[ImuSamples]) -> ImuSamples:
    """Samples of consecutive intervals as one; those on a common border once."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return ImuSamples.empty()
    stamps, first = np.unique(np.concatenate([part.stamps_ns for part in parts]), return_index=True)
    gyro = np.concatenate([part.gyro_rad_s for part in parts])[first]
    accel = np.concatenate([part.accel_m_s2 for part in parts])[first]
    return ImuSamples(stamps, gyro, accel)
