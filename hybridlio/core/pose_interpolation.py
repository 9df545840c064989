"""Interpolation of a vehicle's pose between its scans."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask, Stamps
from hybridlio.core.sensors import NS_PER_S

_STEP_NS = NS_PER_S // 100  # of the central differences for velocities, over which motion is smooth


class PosePath:
    """Poses at any time between known ones: rotations on geodesics, positions on cubic Hermite splines.

    Splines, because a vehicle that accelerates by 4 m/s² is 5 mm off the straight line halfway between two scans 0.1 s
    apart, and 0.5 m between two scans a second apart.

    Args:
        stamps_ns: ``(N,)``, strictly increasing, two or more.
        poses: ``(N, 4, 4)``.
        velocities_m_s: ``(N, 3)`` in world; by default differences of the positions.
    """

    def __init__(self, stamps_ns: Stamps, poses: Array, velocities_m_s: Array | None = None) -> None:
        self.stamps_ns, self.poses = stamps_ns, poses
        self._times_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
        if velocities_m_s is None:
            velocities_m_s = np.gradient(poses[:, :3, 3], self._times_s, axis=0)
        self._position = CubicHermiteSpline(self._times_s, poses[:, :3, 3], velocities_m_s)

    def covers(self, stamps_ns: Stamps) -> Mask:
        """Return ``(M,)`` whether each time is between the first pose and the last."""
        return np.asarray((stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1]))

    def nearest(self, stamps_ns: Stamps) -> Index:
        """Return ``(M,)`` the row of the pose nearest in time."""
        middles = self.stamps_ns[:-1] + np.diff(self.stamps_ns) // 2
        return np.searchsorted(middles, stamps_ns)

    def at(self, stamps_ns: Stamps) -> Array:
        """Return poses ``(M, 4, 4)``; beyond the ends the first or last one."""
        times = np.clip((stamps_ns - self.stamps_ns[0]) / NS_PER_S, 0.0, self._times_s[-1])
        left = np.clip(np.searchsorted(self._times_s, times, side="right") - 1, 0, len(self._times_s) - 2)
        fraction = (times - self._times_s[left]) / (self._times_s[left + 1] - self._times_s[left])
        turned = se3.interpolate(self.poses[left], self.poses[left + 1], fraction)
        return se3.make(turned[:, :3, :3], self._position(times))

    def points(self, stamps_ns: Stamps, lever_m: Array) -> tuple[Array, Array]:
        """Return positions and velocities ``(M, 3)`` in world of a point at ``lever_m`` ``(3,)`` in the body frame."""
        before, here, after = (self.at(stamps_ns + step) @ np.r_[lever_m, 1.0] for step in (-_STEP_NS, 0, _STEP_NS))
        first_ns, last_ns = self.stamps_ns[[0, -1]]
        spans = np.clip(stamps_ns + _STEP_NS, first_ns, last_ns) - np.clip(stamps_ns - _STEP_NS, first_ns, last_ns)
        return here[:, :3], (after - before)[:, :3] / np.maximum(spans / NS_PER_S, 1e-9)[:, None]
