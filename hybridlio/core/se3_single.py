"""Exponential and logarithm of one pose in plain floats; :mod:`hybridlio.core.se3` uses them where there is no batch.

Odometry makes some hundred of them a scan, and array operations on six numbers take ten times as long.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SMALL_ANGLE_RAD = 1e-4  # below it the closed forms lose digits, while the series' next terms are below 1e-17
# A matrix whose quaternion has a squared length off by more than this is no rotation within rounding.
ROTATION_TOLERANCE = 1e-9
_NEAR_ROTATION = 0.1  # largest entry of RᵀR − 1 from which steps converge, to 1e-16 within the number below
_MOST_STEPS = 5
_SQUARED_IS_ROUNDING = 1e-9
_EYE = np.eye(3)

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


def exp(xi: Array) -> Array:
    """Return the pose ``(4, 4)`` of a tangent vector ``(6,)``."""
    x, y, z, vx, vy, vz = xi.tolist()
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < SMALL_ANGLE_RAD:
        a, b, c = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        sine = math.sin(angle)
        a, b, c = sine / angle, 2 * math.sin(angle / 2) ** 2 / squared, (angle - sine) / (squared * angle)
    along = c * (x * vx + y * vy + z * vz)  # V·v = (1 − c·θ²)·v + b·(ω × v) + c·ω·(ω·v)
    keep = 1 - c * squared
    return np.array(
        [
            [
                1 - b * (y * y + z * z),
                b * x * y - a * z,
                b * x * z + a * y,
                keep * vx + b * (y * vz - z * vy) + along * x,
            ],
            [
                b * x * y + a * z,
                1 - b * (x * x + z * z),
                b * y * z - a * x,
                keep * vy + b * (z * vx - x * vz) + along * y,
            ],
            [
                b * x * z - a * y,
                b * y * z + a * x,
                1 - b * (x * x + y * y),
                keep * vz + b * (x * vy - y * vx) + along * z,
            ],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def log(T: Array) -> Array | None:
    """Return the tangent vector ``(6,)`` of a pose ``(4, 4)``; None where its rotation is off by more than rounding."""
    rotvec = rotation_vector(T)
    if rotvec is None:
        return None
    x, y, z = rotvec
    vx, vy, vz = T[:3, 3].tolist()
    squared = x * x + y * y + z * z
    half = math.sqrt(squared) / 2
    d = 1 / 12 + squared / 720 if half < SMALL_ANGLE_RAD / 2 else (1 - half * math.cos(half) / math.sin(half)) / squared
    # V⁻¹·v = (1 − d·θ²)·v − (ω × v)/2 + d·ω·(ω·v)
    keep, along = 1 - d * squared, d * (x * vx + y * vy + z * vz)
    return np.array(
        [
            x,
            y,
            z,
            keep * vx - (y * vz - z * vy) / 2 + along * x,
            keep * vy - (z * vx - x * vz) / 2 + along * y,
            keep * vz - (x * vy - y * vx) / 2 + along * z,
        ]
    )


def nearest_rotation(T: Array) -> Array | None:
    """Return the pose ``(4, 4)`` with the nearest rotation (Frobenius norm); None where that is not near at all.

    By Newton's iteration for the polar factor without an inverse (Björck and Bowie, 1971), whose error is squared by
    each step.
    """
    R = T[:3, :3]
    for _ in range(_MOST_STEPS):
        excess = R.T @ R - _EYE
        size = float(np.abs(excess).max())
        if not size < _NEAR_ROTATION:
            return None
        R = R - R @ excess / 2
        if size < _SQUARED_IS_ROUNDING:
            break
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        return None  # a reflection
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, T[:3, 3]
    return out


def rotation_vector(T: Array) -> Vector | None:
    """Return the rotation vector by the quaternion whose largest component divides the others (Shepperd, 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        w, x, y, z = 1 + trace, h - f, c - g, d - b
    elif largest == a:
        w, x, y, z = h - f, 1 + a - e - i, b + d, c + g
    elif largest == e:
        w, x, y, z = c - g, b + d, 1 + e - a - i, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1 + i - a - e
    squared = x * x + y * y + z * z
    # the quaternion of a rotation has four times the length of its component that divides
    if not abs(w * w + squared - 4 * (1 + 2 * largest - trace)) < ROTATION_TOLERANCE:
        return None
    sine = math.sqrt(squared)
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    factor = 2 * math.atan2(sine, w) / sine if sine > 0 else 2 / w
    return factor * x, factor * y, factor * z
