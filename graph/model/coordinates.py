"""Poses as coordinates, the form in which a pose graph stores them and text formats write them.

In space seven numbers, ``x y z qx qy qz qw``; in the plane three, ``x y θ``. Storing what a file holds, instead of a
matrix, makes files read and written back equal to the last bit. Users see ``(4, 4)`` matrices in both cases.
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
from hybridlio.core.se3 import as_floats

Dimension: TypeAlias = Literal[2, 3]

IDENTITY: dict[int, Array] = {2: np.zeros(3), 3: np.r_[np.zeros(6), 1.0]}
TANGENT_SIZE: dict[int, int] = {2: 3, 3: 6}
UP = np.array([0.0, 0.0, 1.0])  # in world, against gravity
# Positions of our tangent components, rotation first, in GTSAM's tangent vectors (Pose2 has x, y, θ) and in the
# information matrices of text formats (translation first).
GTSAM_ORDER: dict[int, list[int]] = {2: [1, 2, 0], 3: [0, 1, 2, 3, 4, 5]}
TEXT_ORDER: dict[int, list[int]] = {2: [1, 2, 0], 3: [3, 4, 5, 0, 1, 2]}

_PLANAR = np.ix_([0, 1, 3], [0, 1, 3])  # cells of a (4, 4) pose that a (3, 3) planar pose fills
_PLANAR_TOLERANCE = 1e-9  # rad, m: rounding of a matrix product, far below any measurement


def from_matrix(T: ArrayLike, dimension: Dimension, name: str) -> Array:
    """Return the coordinates of one pose ``(4, 4)``, or in the plane ``(3, 3)``.

    GTSAM's ``Pose3`` and ``Pose2`` are taken too, and coordinates ``x y z qx qy qz qw`` or ``x y θ``.

    Raises:
        DataError: not a rigid transform, or out of the plane of a planar graph; the message starts with ``name``.
    """
    if isinstance(T, gtsam.Pose3 | gtsam.Pose2):
        T = T.matrix()
    T = as_floats(T, name)
    if T.shape == IDENTITY[dimension].shape:
        T = _from_coordinates(T, name)
    if dimension == 3:
        T = se3.check_pose(T, name)
        return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])
    if T.shape == (3, 3):
        T = _lift(T)
    T = se3.check_pose(T, name)
    if np.abs(T - _lift(T[_PLANAR])).max() > _PLANAR_TOLERANCE:
        raise DataError(f"{name}: the graph is planar, but the pose's z, roll or pitch is not zero")
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


def _from_coordinates(values: Array, name: str) -> Array:
    """Return the pose ``(4, 4)`` of ``x y θ``, or of ``x y z qx qy qz qw``."""
    if not np.isfinite(values).all() or (len(values) == 7 and not values[3:].any()):
        raise DataError(f"{name}: expected finite coordinates and a quaternion that is not zero, got {values.tolist()}")
    return np.asarray(to_matrices(values[None])[0])


def _lift(T: Array) -> Array:
    lifted = np.eye(4)
    lifted[_PLANAR] = T
    return lifted


def to_matrices(coordinates: Array) -> Array:
    """Return the poses ``(N, 4, 4)`` of coordinates ``(N, 7)`` or ``(N, 3)``."""
    if coordinates.shape[1] == 7:
        return se3.make(Rotation.from_quat(coordinates[:, 3:]).as_matrix(), coordinates[:, :3])
    c, s = np.cos(coordinates[:, 2]), np.sin(coordinates[:, 2])
    T = np.tile(np.eye(4), (len(coordinates), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :2, 3] = coordinates[:, :2]
    return T


def from_matrices(T: Array, dimension: Dimension) -> Array:
    """Return the coordinates ``(N, 7)`` or ``(N, 3)`` of valid poses ``(N, 4, 4)``, without checks."""
    if dimension == 2:
        return np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    return np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)])


def gtsam_poses(coordinates: Array) -> list[Any]:
    """Return the poses as GTSAM's ``Pose3``, or ``Pose2`` in the plane."""
    if coordinates.shape[1] == 3:
        return [gtsam.Pose2(x, y, theta) for x, y, theta in coordinates.tolist()]
    make_rotation, make_pose = gtsam.Rot3.Quaternion, gtsam.Pose3
    quaternions = coordinates[:, 3:] / np.linalg.norm(coordinates[:, 3:], axis=1, keepdims=True)
    x, y, z, w = quaternions.T.tolist()
    return list(map(make_pose, map(make_rotation, w, x, y, z), coordinates[:, :3]))


def our_order(matrix: Array, dimension: Dimension) -> Array:
    """Return a matrix over GTSAM's tangent vectors in our order, rotation first."""
    if dimension == 3:
        return np.array(matrix)
    order = np.argsort(GTSAM_ORDER[2])
    return np.asarray(matrix[np.ix_(order, order)])


def relative_covariance(joint: Array, T_b_a: Array, dimension: Dimension) -> Array:
    """Return the covariance ``(d, d)`` of pose ``b`` in the frame of pose ``a``.

    First-order propagation through ``T_a_b = T_a⁻¹ T_b``: a right perturbation of ``T_a`` acts on ``T_a_b`` by
    ``-Ad(T_b_a)``, one of ``T_b`` by the identity.

    Args:
        joint: GTSAM's joint marginal covariance of both poses, ``(2d, 2d)``.
        T_b_a: pose ``a`` in the frame of pose ``b``, ``(4, 4)``.
        dimension: of the graph.
    """
    d = TANGENT_SIZE[dimension]
    blocks = np.block([[our_order(joint[m : m + d, n : n + d], dimension) for n in (0, d)] for m in (0, d)])
    J = np.hstack([-adjoint(T_b_a, dimension), np.eye(d)])
    covariance = J @ blocks @ J.T
    return np.asarray((covariance + covariance.T) / 2)


def adjoint(T: Array, dimension: Dimension) -> Array:
    """Return the adjoint of one pose ``(4, 4)`` in our order: ``(6, 6)``, or ``(3, 3)`` in the plane."""
    full = se3.adjoint(T)
    return full if dimension == 3 else np.asarray(full[2:5, 2:5])
