"""Places: keyframes with their surroundings, which are recognised and registered to one another.

Loop closure compares the places of one run, localisation those of a run with those of a map, and merging those of two
runs.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.smoothing.step_uncertainty import OdometryChain


class Places(Protocol):
    """Places by number, each with a frame of its own: that of the lidar there."""

    def __len__(self) -> int:
        """Return their number."""
        ...

    @property
    def travelled_m(self) -> Array:
        """``(K,)`` distance along the path of each."""
        ...

    @property
    def levels(self) -> Array:
        """``(K, 4, 4)`` rotations ``T_level_place`` that make up the z axis."""
        ...

    def points(self, k: int) -> Array:
        """Return the points ``(N, 3)`` of place ``k`` alone, in its frame."""
        ...

    def surroundings(self, k: int) -> Array:
        """Return the points ``(N, 3)`` of place ``k`` and its neighbours along the path, in its frame."""
        ...

    def distortion(self, k: int) -> Array:
        """Return the error ``(6, 6)`` of merged surroundings: the mean covariance of the merged places' poses."""
        ...


class KeyframePlaces:
    """The loop keyframes of a run as places.

    Args:
        keyframes: of the run.
        chain: its odometry; only relative poses of nearby keyframes are used.
        up: ``(3,)`` in the first scan's frame.
        reach_m: keyframes this near along the path on either side are merged to the surroundings.
    """

    def __init__(self, keyframes: LoopKeyframes, chain: OdometryChain, up: Array, reach_m: float) -> None:
        self._keyframes, self._chain, self._reach_m = keyframes, chain, reach_m
        self.travelled_m: Array = chain.travelled_m[keyframes.rows]
        self.levels = levelling_rotations(chain.poses[keyframes.rows], up)

    def __len__(self) -> int:
        return len(self._keyframes)

    def points(self, k: int) -> Array:
        """Return the points ``(N, 3)`` of keyframe ``k``, in its frame."""
        return self._keyframes.points(k)

    def surroundings(self, k: int) -> Array:
        """Return the points ``(N, 3)`` of keyframe ``k`` and its neighbours along the path, in its frame."""
        near, rows = self._near(k), self._keyframes.rows
        relative = self._chain.relative(rows[k], rows[near])
        clouds = [self._keyframes.points(int(j)) for j in near]
        return np.concatenate([se3.transform(T, points) for T, points in zip(relative, clouds, strict=True)])

    def distortion(self, k: int) -> Array:
        """Return the mean covariance ``(6, 6)`` of odometry to the keyframes merged to the surroundings."""
        rows = self._keyframes.rows
        near = rows[self._near(k)]
        return np.asarray(self._chain.covariance(near, np.full(len(near), rows[k])).mean(axis=0))

    def _near(self, k: int) -> Index:
        """Keyframes within reach of keyframe ``k`` along the path, itself included."""
        return np.flatnonzero(np.abs(self.travelled_m - self.travelled_m[k]) <= self._reach_m)


def levelling_rotations(poses: Array, up: Array) -> Array:
    """Return ``(K, 4, 4)`` rotations ``T_level_lidar`` that make ``up`` the z axis, by the smallest angle.

    Args:
        poses: ``(K, 4, 4)`` ``T_world_lidar``.
        up: ``(3,)`` in world.
    """
    local = poses[:, :3, :3].transpose(0, 2, 1) @ (up / np.linalg.norm(up))
    axis = np.cross(local, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis, axis=1), local[:, 2]
    angle = np.arctan2(sine, cosine)
    rotations = se3.so3_exp(axis * (angle / np.maximum(sine, 1e-12))[:, None])
    return se3.make(rotations, np.zeros((len(poses), 3)))
