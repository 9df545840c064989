"""Rotations of a lidar between stamps, and those of a gyroscope over the same times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.core.trajectory import Trajectory

# Longest time between two samples of a step that is compared: half a step of a 10 Hz lidar. Rates between samples
# farther apart are unknown.
_LONGEST_GAP_S = 0.05


@dataclass(frozen=True, eq=False)
class Turns:
    """Rotations of a lidar over ``N`` steps.

    Attributes:
        starts_ns, ends_ns: ``(N,)`` int64, in order of time.
        rotvecs: ``(N, 3)`` rotation vectors from start to end in the lidar frame, rad.
        measured: ``(N, 3)`` whether the lidar measured the turn about each of its axes.
    """

    starts_ns: Stamps
    ends_ns: Stamps
    rotvecs: Array
    measured: Mask

    @classmethod
    def of(cls, *trajectories: Trajectory, measured: Mask | None = None) -> Turns:
        """Return the steps between consecutive poses of trajectories that follow each other in time.

        Args:
            trajectories: each of two poses or more.
            measured: see :class:`Turns`, for all steps one after the other; by default all turns are measured.
        """
        starts, ends, rotvecs = [], [], []
        for path in trajectories:
            starts.append(path.stamps_ns[:-1])
            ends.append(path.stamps_ns[1:])
            rotvecs.append(se3.so3_log(se3.between(path.poses[:-1], path.poses[1:])[:, :3, :3]))
        turns = np.concatenate(rotvecs)
        all_measured = np.ones(turns.shape, bool) if measured is None else measured
        return cls(np.concatenate(starts), np.concatenate(ends), turns, all_measured)

    def __len__(self) -> int:
        return len(self.starts_ns)

    @property
    def spans_s(self) -> Array:
        """``(N,)`` durations of the steps."""
        return np.asarray((self.ends_ns - self.starts_ns) / NS_PER_S)

    @property
    def joined(self) -> Mask:
        """``(N-1,)`` whether a step ends where the next one starts."""
        return np.asarray(self.ends_ns[:-1] == self.starts_ns[1:])

    def at(self, rows: Mask) -> Turns:
        """Return some of the steps."""
        return Turns(self.starts_ns[rows], self.ends_ns[rows], self.rotvecs[rows], self.measured[rows])


class GyroPath:
    """The orientation of an IMU by its gyroscope, whose rates are linear between samples.

    Args:
        imu: two samples or more.
        origin_ns: stamp that times in seconds count from.

    Raises:
        DataError: fewer than two samples.
    """

    def __init__(self, imu: ImuSamples, origin_ns: int) -> None:
        if len(imu) < 2:
            raise DataError(f"gyroscope: {len(imu)} samples, at least 2 are needed")
        self._times_s = (imu.stamps_ns - origin_ns) / NS_PER_S
        self._rates = imu.gyro_rad_s
        self._steps_s = np.diff(self._times_s)
        gaps = self._steps_s > _LONGEST_GAP_S
        self._gaps_so_far = np.concatenate([[0], np.cumsum(gaps)])
        means = (self._rates[1:] + self._rates[:-1]) / 2
        R = np.concatenate([np.eye(3)[None], se3.so3_exp(means * self._steps_s[:, None])])
        shift = 1
        while shift < len(R):  # products of all turns up to each sample, in log2(S) passes over the array
            R[shift:] = R[:-shift] @ R[shift:]
            shift *= 2
        self._R = R
        self._integral = np.concatenate([np.zeros((1, 3)), np.cumsum(means * self._steps_s[:, None], axis=0)])

    def covers(self, starts_s: Array, ends_s: Array) -> Mask:
        """Return ``(N,)`` whether samples without a gap surround each interval."""
        inside = (starts_s >= self._times_s[0]) & (ends_s <= self._times_s[-1])
        first = self._interval(starts_s)
        last = self._interval(ends_s) + 1
        return np.asarray(inside & (self._gaps_so_far[last] == self._gaps_so_far[first]))

    def turns(self, starts_s: Array, ends_s: Array) -> Array:
        """Return rotation vectors ``(N, 3)`` over the intervals, in the IMU frame at their starts."""
        return se3.so3_log(np.swapaxes(self._at(starts_s), -1, -2) @ self._at(ends_s))

    def integrals(self, starts_s: Array, ends_s: Array) -> Array:
        """Return the rates' integrals ``(N, 3)`` over the intervals, axis by axis.

        Unlike rotations they have no bound, so they suit rates that may be in another unit.
        """
        return self._integral_at(ends_s) - self._integral_at(starts_s)

    def _integral_at(self, times_s: Array) -> Array:
        k = self._interval(times_s)
        return self._integral[k] + self._since(k, times_s)

    def _interval(self, times_s: Array) -> Stamps:
        return np.clip(np.searchsorted(self._times_s, times_s, side="right") - 1, 0, len(self._steps_s) - 1)

    def _at(self, times_s: Array) -> Array:
        k = self._interval(times_s)
        return np.asarray(self._R[k] @ se3.so3_exp(self._since(k, times_s)))

    def _since(self, k: Stamps, times_s: Array) -> Array:
        """Return the rates' integrals ``(N, 3)`` from samples ``k`` to times before the next ones."""
        into = (times_s - self._times_s[k])[:, None]
        slope = (self._rates[k + 1] - self._rates[k]) / self._steps_s[k, None]
        return np.asarray(self._rates[k] * into + slope * into**2 / 2)
