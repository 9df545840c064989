"""Where a vehicle was between its scans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S

_NEAR_NS = NS_PER_S // 100  # velocities are those over so long to either side


class PosePath:
    """Poses at any time, from poses at some: rotations on the geodesic, positions on cubics of matching velocity.

    A vehicle that accelerates by 4 m/s² is 5 mm off the straight line halfway between two scans 0.1 s apart, and
    0.5 m between two a second apart; the cubics follow it.

    Args:
        stamps_ns: ``(N,)``, strictly increasing, two or more.
        poses: ``(N, 4, 4)``.
        velocities_m_s: ``(N, 3)`` in the poses' world; by default from the positions.
    """

    def __init__(self, stamps_ns: NDArray[np.int64], poses: Array, velocities_m_s: Array | None = None) -> None:
        self.stamps_ns, self.poses = stamps_ns, poses
        self._times_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
        if velocities_m_s is None:
            velocities_m_s = np.gradient(poses[:, :3, 3], self._times_s, axis=0)
        self._position = CubicHermiteSpline(self._times_s, poses[:, :3, 3], velocities_m_s)

    def covers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """``(M,)`` whether a time lies between the first pose and the last."""
        return np.asarray((stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1]))

    def nearest(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """``(M,)`` the row of the pose nearest in time."""
        middles = self.stamps_ns[:-1] + np.diff(self.stamps_ns) // 2
        return np.searchsorted(middles, stamps_ns)

    def at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Poses ``(M, 4, 4)``; those beyond the ends stay at the ends."""
        times = np.clip((stamps_ns - self.stamps_ns[0]) / NS_PER_S, 0.0, self._times_s[-1])
        left = np.clip(np.searchsorted(self._times_s, times, side="right") - 1, 0, len(self._times_s) - 2)
        fraction = (times - self._times_s[left]) / (self._times_s[left + 1] - self._times_s[left])
        turned = se3.interpolate(self.poses[left], self.poses[left + 1], fraction)
        return se3.make(turned[:, :3, :3], self._position(times))

    def points(self, stamps_ns: NDArray[np.int64], lever_m: Array) -> tuple[Array, Array]:
        """Positions and velocities ``(M, 3)`` in world of a point that sits at ``lever_m`` ``(3,)`` in the body."""
        before, here, after = (self.at(stamps_ns + step) @ np.r_[lever_m, 1.0] for step in (-_NEAR_NS, 0, _NEAR_NS))
        spans = np.clip(stamps_ns + _NEAR_NS, *self.stamps_ns[[0, -1]]) - np.clip(
            stamps_ns - _NEAR_NS, *self.stamps_ns[[0, -1]]
        )
        return here[:, :3], (after - before)[:, :3] / np.maximum(spans / NS_PER_S, 1e-9)[:, None]
