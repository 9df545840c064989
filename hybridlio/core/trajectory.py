"""A trajectory: stamped lidar poses with covariances. :mod:`hybridlio.core.trajectory_files` reads and writes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes:
        stamps_ns: ``(N,)`` int64, strictly increasing.
        poses: ``(N, 4, 4)`` ``T_world_lidar``; world is the lidar frame of the first scan unless stated otherwise.
        covariances: ``(N, 6, 6)`` of right perturbations, rad² and m², rotation first; None if unknown.

    Raises:
        DataError: a shape is wrong, a pose is not finite, or time does not increase.
    """

    stamps_ns: Stamps
    poses: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns, dtype=np.int64)
        poses = np.asarray(self.poses, dtype=np.float64)
        if poses.shape != (len(stamps), 4, 4) or not np.isfinite(poses).all():
            raise DataError(f"trajectory: expected finite ({len(stamps)}, 4, 4) poses, got shape {poses.shape}")
        backwards = np.diff(stamps) <= 0
        if backwards.any():
            raise DataError(f"trajectory: time does not increase at row {int(backwards.argmax()) + 1}")
        if self.covariances is not None and np.shape(self.covariances) != (len(stamps), 6, 6):
            raise DataError(f"trajectory: covariances must be ({len(stamps)}, 6, 6), got {np.shape(self.covariances)}")
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "poses", se3.orthonormalise(poses))

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory(0 poses)"
        covariances = "" if self.covariances is None else ", with covariances"
        return f"Trajectory({len(self)} poses, {self.times_s[-1]:.1f} s, {self.length_m:.1f} m{covariances})"

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def times_s(self) -> Array:
        """Seconds ``(N,)`` since the first pose."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) / 1e9)

    @property
    def length_m(self) -> float:
        """Path length in metres."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())

    def from_first(self) -> Trajectory:
        """Return the same poses in the frame of the first one."""
        return Trajectory(self.stamps_ns, se3.between(self.poses[0], self.poses), self.covariances)


def travelled_m(positions_m: Array) -> Array:
    """Return the path length ``(N,)`` from the first position to each of ``(N, 3)`` positions."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1)))
