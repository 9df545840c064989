"""The motion of several scans by the IMU, from which their joint motion departs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hybridlio.cloud.deskew import deskew
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.registration.joint_motion import JointPoints


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """A motion by the IMU, and the stamps of the scans on it."""

    motion: Trajectory
    stamps_ns: list[int]

    @cached_property
    def times_s(self) -> Array:
        """``(K,)`` of the scans since the first."""
        return (np.array(self.stamps_ns) - self.stamps_ns[0]) / NS_PER_S

    @cached_property
    def from_first(self) -> Array:
        """``(S, 4, 4)`` all poses, in the frame of the first scan."""
        first = int(np.searchsorted(self.motion.stamps_ns, self.stamps_ns[0]))
        return np.asarray(se3.inverse(self.motion.poses[first]) @ self.motion.poses)

    @property
    def poses(self) -> Array:
        """``(K, 4, 4)`` of the scans."""
        return np.asarray(self.from_first[np.searchsorted(self.motion.stamps_ns, self.stamps_ns)])

    def poses_beside(self, xi: Array) -> Array:
        """Return the scans' poses ``(K, 4, 4)`` by the base and a motion ``(9,)`` beside it."""
        t, poses = self.times_s[:, None], self.poses
        turned = se3.so3_exp(t * xi[:3]) @ poses[:, :3, :3]
        return np.asarray(se3.make(turned, poses[:, :3, 3] + t * xi[3:6] + t**2 / 2 * xi[6:]))

    def place(self, scan: Scan, points: Array, k: int, kept: Index) -> JointPoints:
        """Return some of scan ``k``'s points ``(N, 3)``, which are compensated, as the base places them."""
        times_s = np.full(len(kept), self.times_s[k])
        if scan.time_offsets_ns is not None:
            times_s = times_s + scan.time_offsets_ns[kept] / NS_PER_S
        knots_s = (self.motion.stamps_ns - self.stamps_ns[0]) / NS_PER_S
        centres = np.column_stack([np.interp(times_s, knots_s, self.from_first[:, i, 3]) for i in range(3)])
        return JointPoints(se3.transform(self.poses[k], points[kept]), centres, times_s, np.full(len(kept), k))

    def compensated(self, scan: Scan, k: int, xi: Array) -> Scan:
        """Return scan ``k`` compensated by the base and a motion ``(9,)`` beside it."""
        if scan.time_offsets_ns is None:
            return scan
        by_base = deskew(scan, self.motion)
        placed = self.place(scan, by_base.points.astype(np.float64), k, np.arange(len(scan)))
        points = se3.transform(se3.inverse(self.poses_beside(xi)[k]), placed.moved(xi))
        return replace(by_base, points=points.astype(np.float32))
