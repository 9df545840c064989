"""Rigid transforms in NumPy: the group SE(3), its tangent space, and covariances on it.

Conventions (GTSAM's): a pose is a float64 ``(..., 4, 4)`` matrix; a tangent vector is ``(..., 6)``, rotation first,
``[ωx ωy ωz vx vy vz]``; perturbations are on the right, ``T·Exp(ξ)``. Every function takes leading batch dimensions.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), §D (SE(3)).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridlio.core import se3_single
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, shown
from hybridlio.core.se3_single import ROTATION_TOLERANCE, SMALL_ANGLE_RAD

_EYE, _LAST = np.eye(3), [0.0, 0.0, 0.0, 1.0]  # the identity rotation; the last row of every pose


def hat(v: ArrayLike) -> Array:
    """Return the skew matrices ``(..., 3, 3)`` of vectors ``(..., 3)``: ``hat(a) @ b == cross(a, b)``."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(rotvec: ArrayLike) -> Array:
    """Return the rotation matrices ``(..., 3, 3)`` of rotation vectors ``(..., 3)`` in radians."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    flat = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix()
    return np.asarray(flat.reshape(*rotvec.shape[:-1], 3, 3))


def so3_log(R: ArrayLike) -> Array:
    """Return the rotation vectors ``(..., 3)`` (rad, length at most π) of rotation matrices ``(..., 3, 3)``."""
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2 and (rotvec := se3_single.rotation_vector(R)) is not None:
        return np.array(rotvec)
    return _rotation_vectors(R.reshape(-1, 3, 3)).reshape(*R.shape[:-2], 3)


def _rotation_vectors(R: Array) -> Array:
    """Return the rotation vectors ``(N, 3)`` of matrices ``(N, 3, 3)``: below 90° by the quaternion, else by SciPy's.

    SciPy takes ten times as long, for a choice of the quaternion's component and a check of the matrix for each.
    """
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
    w, squared = 1 + np.trace(R, axis1=1, axis2=2), np.einsum("ni,ni->n", axis, axis)
    sine = np.sqrt(squared)
    factor = np.where(sine > 0, 2 * np.arctan2(sine, w) / np.where(sine > 0, sine, 1.0), 2 / np.maximum(w, 1.0))
    rotvec = np.asarray(factor[:, None] * axis)
    # the quaternion of a rotation has a length of 2√w here; another matrix is left to SciPy, which orthonormalises
    other = ~((w > 2) & (np.abs(w**2 + squared - 4 * w) < ROTATION_TOLERANCE))
    if other.any():
        rotvec[other] = Rotation.from_matrix(R[other]).as_rotvec()
    return rotvec


def so3_left_jacobian(rotvec: ArrayLike) -> Array:
    """Return the left Jacobians ``(..., 3, 3)`` of SO(3) at rotation vectors ``(..., 3)`` (Solà et al., eq. 145)."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    small = angle < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, 2 * np.sin(safe / 2) ** 2 / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    K = hat(rotvec)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def turns_by_rates(rates_rad_s: Array, steps_s: Array) -> Array:
    """Return rotation vectors ``(S - 1, 3)`` between samples of rates ``(S, 3)``, rad, that change linearly between."""
    return np.asarray((rates_rad_s[1:] + rates_rad_s[:-1]) / 2 * steps_s[:, None])


def so3_chain(turns: Array) -> Array:
    """Return rotations ``(N + 1, 3, 3)`` to the first frame, by rotations ``(N, 3, 3)`` from each frame to the next."""
    out = [np.eye(3)]
    for turn in turns:
        out.append(out[-1] @ turn)
    return np.array(out)


def make(R: ArrayLike, t: ArrayLike) -> Array:
    """Return poses ``(..., 4, 4)`` with rotations ``(..., 3, 3)`` and translations ``(..., 3)`` in metres."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def exp(xi: ArrayLike) -> Array:
    """Return the poses ``(..., 4, 4)`` of tangent vectors ``(..., 6)`` (rad, m); inverse of :func:`log`."""
    xi = np.asarray(xi, dtype=np.float64)
    if xi.ndim == 1:
        return se3_single.exp(xi)
    t = (so3_left_jacobian(xi[..., :3]) @ xi[..., 3:, None])[..., 0]
    return make(so3_exp(xi[..., :3]), t)


def log(T: ArrayLike) -> Array:
    """Return the tangent vectors ``(..., 6)`` (rad, m) of poses ``(..., 4, 4)``; the angle is at most π."""
    T = np.asarray(T, dtype=np.float64)
    if T.ndim == 2 and (xi := se3_single.log(T)) is not None:
        return xi
    rotvec = so3_log(T[..., :3, :3])
    return np.concatenate([rotvec, _left_jacobian_solved(rotvec, T[..., :3, 3])], axis=-1)


def _left_jacobian_solved(rotvec: Array, t: Array) -> Array:
    """Return ``J⁻¹·t`` ``(..., 3)`` for the left Jacobians ``J`` of rotation vectors of at most π (Solà, eq. 146)."""
    angle = np.linalg.norm(rotvec, axis=-1)[..., None]
    small = angle < SMALL_ANGLE_RAD
    half = np.where(small, 1.0, angle) / 2
    c = np.where(small, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / (4 * half**2))
    turned = np.cross(rotvec, t)
    return np.asarray(t - turned / 2 + c * np.cross(rotvec, turned))


def inverse(T: ArrayLike) -> Array:
    """Return the inverse poses ``T_b_a`` of ``T_a_b``. Shape ``(..., 4, 4)``."""
    T = np.asarray(T, dtype=np.float64)
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(R_inv, -(R_inv @ T[..., :3, 3, None])[..., 0])


def between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Array:
    """Return the relative poses ``T_a_b = T_w_a⁻¹ T_w_b``. Shape ``(..., 4, 4)``."""
    return np.asarray(inverse(T_w_a) @ np.asarray(T_w_b, dtype=np.float64))


def adjoint(T: ArrayLike) -> Array:
    """Return the adjoints ``(..., 6, 6)`` with ``T·Exp(ξ) == Exp(Ad(T)·ξ)·T`` (Solà et al., eq. 175, reordered)."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out


def transform(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Return points ``(..., N, 3)`` that are given in frame b, in frame a."""
    T, p = np.asarray(T_a_b, dtype=np.float64), np.asarray(points_b)
    return np.asarray(p @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


def interpolate(T_a: ArrayLike, T_b: ArrayLike, fraction: ArrayLike) -> Array:
    """Return the poses ``(..., 4, 4)`` on the geodesic from ``T_a`` (fraction 0) to ``T_b`` (fraction 1)."""
    T_a = np.asarray(T_a, dtype=np.float64)
    step = log(between(T_a, T_b))
    return np.asarray(T_a @ exp(np.asarray(fraction, dtype=np.float64)[..., None] * step))


def orthonormalise(T: ArrayLike) -> Array:
    """Return the poses ``(..., 4, 4)`` with their rotations replaced by the nearest ones (Frobenius norm)."""
    T = np.asarray(T, dtype=np.float64)
    if T.ndim == 2 and (near := se3_single.nearest_rotation(T)) is not None:
        return near
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U = U * np.stack([np.ones_like(d := np.linalg.det(U @ Vt)), np.ones_like(d), d], axis=-1)[..., None, :]
    return make(U @ Vt, T[..., :3, 3])


def compose_covariance(cov_a: ArrayLike, T_b: ArrayLike, cov_b: ArrayLike) -> Array:
    """Return the covariance ``(..., 6, 6)`` of ``A·B`` for independent ``A`` and ``B``, to first order."""
    Ad = adjoint(inverse(T_b))
    return np.asarray(Ad @ np.asarray(cov_a) @ np.swapaxes(Ad, -1, -2) + np.asarray(cov_b))


def rotate_covariance(cov_b: ArrayLike, T_a_b: ArrayLike) -> Array:
    """Return the covariance ``(..., 6, 6)`` of ``T_a_b·X·T_a_b⁻¹``: the relative pose ``X`` seen from another frame."""
    Ad = adjoint(T_a_b)
    return np.asarray(Ad @ np.asarray(cov_b) @ np.swapaxes(Ad, -1, -2))


def as_floats(values: ArrayLike, name: str) -> Array:
    """Return numbers that a user gave as float64; an array of that type is not copied.

    Raises:
        DataError: it is no real number and no array of such; the message starts with ``name``.
    """
    try:
        if not np.iscomplexobj(values):
            return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise _not_numbers(values, name) from None
    raise _not_numbers(values, name)


def _not_numbers(values: ArrayLike, name: str) -> DataError:
    return DataError(f"{name}: expected numbers, got {type(values).__name__} {shown(values)}")


def check_position(values: ArrayLike, name: str) -> Array:
    """Return a position as float64 ``(3,)``.

    Raises:
        DataError: it is not three finite numbers.
    """
    position = as_floats(values, name)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise DataError(f"{name}: expected three finite coordinates in metres, got {position.tolist()}")
    return position


def check_pose(T: ArrayLike, name: str) -> Array:
    """Return the pose as float64 ``(4, 4)``; a rotation that is off by rounding is made orthonormal.

    Raises:
        DataError: the shape is not ``(4, 4)``, a value is not finite, or the rotation is off by more than 1e-3.
    """
    T = as_floats(T, name)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise DataError(f"{name}: expected a finite (4, 4) pose, got shape {T.shape}")
    if np.abs(T[:3, :3]).max() > 2:  # a larger one is no rotation, and its square may overflow
        raise DataError(f"{name}: not a rigid transform (rotation not orthonormal)")
    if np.abs(T[:3, :3].T @ T[:3, :3] - _EYE).max() < 1e-12 and np.linalg.det(T[:3, :3]) > 0 and T[3].tolist() == _LAST:
        return T.copy()  # almost always; the singular value decomposition below takes three times as long
    clean = orthonormalise(T)
    if np.abs(clean[:3, :3] - T[:3, :3]).max() > 1e-3 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise DataError(f"{name}: not a rigid transform ({_why_not_rigid(T)})")
    return clean


def _why_not_rigid(T: Array) -> str:
    if np.abs(T[3] - _LAST).max() > 1e-9:
        transposed = bool(T[:, 3].tolist() == _LAST)
        return "last row not 0 0 0 1" + ("; transposed, the translation belongs in the last column" * transposed)
    R = T[:3, :3]
    mirrored = bool(np.abs(R.T @ R - _EYE).max() < 1e-3)
    return "an axis is mirrored, the determinant is -1" if mirrored else "rotation not orthonormal"
