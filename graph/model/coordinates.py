"""Poses as a pose graph keeps them: the numbers that text formats hold, so that nothing is lost between the two.

In space seven numbers, ``x y z qx qy qz qw``; in the plane three, ``x y θ``. At the boundary both are ``(4, 4)``.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError

Dimension: TypeAlias = Literal[2, 3]

IDENTITY: dict[int, Array] = {2: np.zeros(3), 3: np.r_[np.zeros(6), 1.0]}
TANGENT_SIZE: dict[int, int] = {2: 3, 3: 6}
# ours, rotation first, in the order of GTSAM's tangent vectors (Pose2 has x, y, θ) and of text formats' information
GTSAM_ORDER: dict[int, list[int]] = {2: [1, 2, 0], 3: [0, 1, 2, 3, 4, 5]}
TEXT_ORDER: dict[int, list[int]] = {2: [1, 2, 0], 3: [3, 4, 5, 0, 1, 2]}

_PLANAR = np.ix_([0, 1, 3], [0, 1, 3])


def from_matrix(T: ArrayLike, dimension: Dimension, name: str) -> Array:
    """Coordinates of one pose ``(4, 4)``; in the plane ``(3, 3)`` is taken too.

    Raises:
        DataError: not a rigid transform; in the plane, one that leaves it.
    """
    T = np.asarray(T, dtype=np.float64)
    if dimension == 3:
        T = se3.check_pose(T, name)
        return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])
    if T.shape == (3, 3):
        T = _lifted(T)
    T = se3.check_pose(T, name)
    if np.abs(T - _lifted(T[_PLANAR])).max() > 1e-9:
        raise DataError(f"{name}: leaves the plane (z, roll or pitch is not zero), but the graph is planar")
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


def _lifted(T: Array) -> Array:
    lifted = np.eye(4)
    lifted[_PLANAR] = T
    return lifted


def to_matrices(coordinates: Array) -> Array:
    """Poses ``(N, 4, 4)`` of coordinates ``(N, 7)`` or ``(N, 3)``."""
    if coordinates.shape[1] == 7:
        return se3.make(Rotation.from_quat(coordinates[:, 3:]).as_matrix(), coordinates[:, :3])
    c, s = np.cos(coordinates[:, 2]), np.sin(coordinates[:, 2])
    T = np.tile(np.eye(4), (len(coordinates), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :2, 3] = coordinates[:, :2]
    return T


def gtsam_poses(coordinates: Array) -> list[Any]:
    """The poses as GTSAM has them: ``Pose3``, in the plane ``Pose2``."""
    if coordinates.shape[1] == 3:
        return [gtsam.Pose2(x, y, theta) for x, y, theta in coordinates.tolist()]
    turn, make = gtsam.Rot3.Quaternion, gtsam.Pose3
    quaternions = coordinates[:, 3:] / np.linalg.norm(coordinates[:, 3:], axis=1, keepdims=True)
    return [make(turn(w, x, y, z), t) for (x, y, z, w), t in zip(quaternions.tolist(), coordinates[:, :3], strict=True)]


def from_matrices(T: Array, dimension: Dimension) -> Array:
    """Coordinates ``(N, 7)`` or ``(N, 3)`` of poses ``(N, 4, 4)`` that are known to be such."""
    if dimension == 2:
        return np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    return np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)])


def our_order(matrix: Array, dimension: Dimension) -> Array:
    """A matrix over GTSAM's tangent vectors in our order, rotation first."""
    if dimension == 3:
        return np.array(matrix)
    order = np.argsort(GTSAM_ORDER[2])
    return np.asarray(matrix[np.ix_(order, order)])


def relative_covariance(joint: Any, a: int, b: int, T_b_a: Array, dimension: Dimension) -> Array:
    """Covariance of the pose ``b`` in the frame of pose ``a`` from GTSAM's joint marginal, which names them so."""
    blocks = np.block([[our_order(joint.at(m, n), dimension) for n in (a, b)] for m in (a, b)])
    J = np.hstack([-adjoint(T_b_a, dimension), np.eye(TANGENT_SIZE[dimension])])
    covariance = J @ blocks @ J.T
    return np.asarray((covariance + covariance.T) / 2)


def adjoint(T: Array, dimension: Dimension) -> Array:
    """Adjoint of one pose ``(4, 4)``, in our order: ``(6, 6)``, in the plane ``(3, 3)``."""
    full = se3.adjoint(T)
    return full if dimension == 3 else np.asarray(full[2:5, 2:5])
