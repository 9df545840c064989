"""Rigid transforms in PyTorch: batched, differentiable also at the identity, on any device.

The conventions are those of :mod:`hybridlio.core.se3`: a pose is ``(..., 4, 4)``, a tangent vector ``(..., 6)`` with
rotation first, ``[ωx ωy ωz vx vy vz]``, perturbations are on the right, ``T·Exp(ξ)``.

Euler angles are roll, pitch, yaw about the fixed x, y and z axis, in that order: ``R = Rz(yaw)·Ry(pitch)·Rx(roll)``.
The paper does not state an order of Euler angles; at the small angles between two scans all orders nearly agree.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL2 = 1e-4  # squared angle below which the series are exact in float32, and to 1e-14 in float64


def hat(v: Tensor) -> Tensor:
    """Skew matrices ``(..., 3, 3)`` of vectors ``(..., 3)``: ``hat(a) @ b == cross(a, b)``."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape[:-1], 3, 3)


def _coefficients(rotvec: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``sin θ/θ``, ``(1 − cos θ)/θ²`` and ``(θ − sin θ)/θ³`` as ``(..., 1, 1)``; their gradients are finite at 0."""
    squared = (rotvec * rotvec).sum(-1)[..., None, None]
    small = squared < _SMALL2
    safe = torch.where(small, torch.ones_like(squared), squared)  # the unused branch must not produce NaN gradients
    angle = safe.sqrt()
    a = torch.where(small, 1 - squared / 6 + squared**2 / 120, angle.sin() / angle)
    b = torch.where(small, 0.5 - squared / 24 + squared**2 / 720, 2 * (angle / 2).sin() ** 2 / safe)
    c = torch.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, (angle - angle.sin()) / (safe * angle))
    return a, b, c


def _eye(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device)


def so3_exp(rotvec: Tensor) -> Tensor:
    """Rotation matrices ``(..., 3, 3)`` of rotation vectors ``(..., 3)`` in radians."""
    a, b, _ = _coefficients(rotvec)
    K = hat(rotvec)
    return _eye(rotvec) + a * K + b * (K @ K)


def so3_left_jacobian(rotvec: Tensor) -> Tensor:
    """Left Jacobian ``(..., 3, 3)`` of SO(3) at rotation vectors ``(..., 3)`` (Solà et al., eq. 145)."""
    _, b, c = _coefficients(rotvec)
    K = hat(rotvec)
    return _eye(rotvec) + b * K + c * (K @ K)


def so3_log(R: Tensor) -> Tensor:
    """Rotation vectors ``(..., 3)`` in radians, of length at most π, of rotation matrices ``(..., 3, 3)``.

    Computed from the quaternion by its largest component, which is accurate and differentiable at 0 and near π.
    """
    q = _quaternion(R)
    w, v = q[..., 0], q[..., 1:]
    sign = torch.where(w < 0, -torch.ones_like(w), torch.ones_like(w))
    w, v = w * sign, v * sign[..., None]
    squared = (v * v).sum(-1)
    small = squared < _SMALL2
    length = torch.where(small, torch.ones_like(squared), squared).sqrt()
    ratio = squared / (w * w)
    series = 2 / w * (1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7)
    return torch.where(small, series, 2 * torch.atan2(length, w) / length)[..., None] * v


def _quaternion(R: Tensor) -> Tensor:
    """Unit quaternions ``(..., 4)``, real part first, of either sign."""
    m = R.reshape(*R.shape[:-2], 9)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    # row i is 4·q_i times the quaternion; the row of the largest component is divided by no small number
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20], -1),
            torch.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m12 + m21], -1),
            torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1),
        ],
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    row = rows.gather(-2, index).squeeze(-2)
    return row / (row * row).sum(-1, keepdim=True).sqrt()


def make(R: Tensor, t: Tensor) -> Tensor:
    """Poses ``(..., 4, 4)`` from rotations ``(..., 3, 3)`` and translations ``(..., 3)`` in metres."""
    upper = torch.cat([R, t[..., None]], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)


def identity(count: int, like: Tensor) -> Tensor:
    """Return identities ``(count, 4, 4)`` with the type and device of ``like``."""
    return torch.eye(4, dtype=like.dtype, device=like.device).expand(count, 4, 4)


def exp(xi: Tensor) -> Tensor:
    """Poses ``(..., 4, 4)`` of tangent vectors ``(..., 6)`` (rad, m); inverse of :func:`log`."""
    # torch.linalg.matrix_exp would depend, in its last digits, on the rest of the batch
    rotvec, v = xi[..., :3], xi[..., 3:]
    a, b, c = _coefficients(rotvec)
    K, eye = hat(rotvec), _eye(rotvec)
    squared = K @ K
    return make(eye + a * K + b * squared, ((eye + b * K + c * squared) @ v[..., None])[..., 0])


def log(T: Tensor) -> Tensor:
    """Tangent vectors ``(..., 6)`` (rad, m) of poses ``(..., 4, 4)``; the angle is at most π."""
    rotvec = so3_log(T[..., :3, :3])
    v = torch.linalg.solve(so3_left_jacobian(rotvec), T[..., :3, 3, None])[..., 0]
    return torch.cat([rotvec, v], dim=-1)


def inverse(T: Tensor) -> Tensor:
    """Inverse poses: of ``T_a_b``, ``T_b_a``. Shape ``(..., 4, 4)``."""
    R_inv = T[..., :3, :3].transpose(-1, -2)
    return make(R_inv, -(R_inv @ T[..., :3, 3, None])[..., 0])


def transform(T_a_b: Tensor, points_b: Tensor) -> Tensor:
    """Points ``(..., N, 3)`` of frame b, in frame a, in metres."""
    return rotate(T_a_b, points_b) + T_a_b[..., None, :3, 3]


def rotate(T_a_b: Tensor, vectors_b: Tensor) -> Tensor:
    """Directions ``(..., N, 3)`` of frame b, such as normals, in frame a."""
    return vectors_b @ T_a_b[..., :3, :3].transpose(-1, -2)


def euler_to_rotation(angles: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` of roll, pitch, yaw ``(..., 3)`` in radians: ``Rz(yaw)·Ry(pitch)·Rx(roll)``."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = [
        cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
        sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
        -sp, cp * sr, cp * cr,
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*angles.shape[:-1], 3, 3)
