"""What matched points say of a pose: covariance, degenerate directions and step, from the Gauss-Newton Hessian.

Shared by scan matching and the network, whose loss is the same. All Hessians are ``(6, 6)``, rotation first,
of half the weighted squared distances to the planes, right perturbation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import MEASUREMENT_FLOOR_SIGMAS


class NormalNoise(NamedTuple):
    """What normals pretend: some hundredths of a radian off, they have points on one plane say something along it.

    Attributes:
        mean: so much of a point's information, per point, is that noise.
        most: edges of smooth walls were seen to pretend up to three times this, 0.019 of all that is known of
            translation. What says less may be that, or a few trunks.
    """

    mean: float
    most: float


NORMAL_NOISE = NormalNoise(2e-3, 8e-3)
NORMAL_NOISE_OF_THIN = NormalNoise(1.2e-3, 8e-3)  # where planes count the less the thicker they are
UNKNOWN_SIGMA_M = 10.0
_HALF = 0.5  # an eigenvector lies in what is held, or at a right angle to it


def lever_arms(points: Array) -> Array:
    """``(3,)`` metres: root mean square distance of points ``(N, 3)`` from each of the sensor's axes."""
    squares = np.einsum("ij,ij->j", points, points) / max(len(points), 1)
    return np.asarray(np.sqrt(np.maximum(squares.sum() - squares, 1e-6)))


def scaled_spectrum(information: Array, levers_m: Array | None = None) -> tuple[Array, Array, Array]:
    """Eigenvalues ``(6,)``, eigenvectors as columns ``(6, 6)``, and the scaling ``(6,)`` that gives them one unit.

    Rotations are measured in metres at the points' lever arm about each axis (:func:`lever_arms`): in a corridor that
    of yaw is its length, that of roll its width. Without it, at the mean lever arm of what the matches constrain.
    """
    if levers_m is None:
        mean = np.sqrt(max(np.trace(information[:3, :3]), 1e-12) / max(np.trace(information[3:, 3:]), 1e-12))
        levers_m = np.full(3, mean)
    scale = np.ones(6)
    scale[:3] /= levers_m
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    return values, vectors, scale


def strong_directions(information: Array, values: Array, normal_noise: float = NORMAL_NOISE.mean) -> NDArray[np.bool_]:
    """Which eigenvalues ``(6,)`` of :func:`scaled_spectrum` stand out of the noise of the normals."""
    strong: NDArray[np.bool_] = values >= 3 * normal_noise * np.trace(information[3:, 3:])
    return strong


def weak_basis(
    information: Array, levers_m: Array | None = None, normal_noise: float = NORMAL_NOISE.mean
) -> tuple[Array, Array]:
    """The directions ``(6, D)`` that do not stand out, orthonormal in one unit, and what takes them to the tangent."""
    values, vectors, scale = scaled_spectrum(information, levers_m)
    return np.asarray(vectors[:, ~strong_directions(information, values, normal_noise)]), scale


def degenerate_directions(
    information: Array, levers_m: Array | None = None, normal_noise: float = NORMAL_NOISE.mean
) -> Array:
    """``(D, 6)`` unit tangent directions along which the matches say no more than the noise of their normals."""
    basis, to_tangent = weak_basis(information, levers_m, normal_noise)
    directions = (basis * to_tangent[:, None]).T
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def covariance_of(
    information: Array,
    sigma_m: float,
    scale: float,
    levers_m: Array | None = None,
    normal_noise: float = NORMAL_NOISE.mean,
    floor_sigmas: Array = MEASUREMENT_FLOOR_SIGMAS,
    held: Array | None = None,
) -> Array:
    """``scale·σ²·H⁻¹`` ``(6, 6)``, rad² and m², rotation first; 10 m where the matches say nothing.

    Args:
        information: the Hessian.
        sigma_m: standard deviation of the distances to the planes.
        scale: how much larger it is than independent residuals would make it: points on one surface share its error.
        levers_m: of :func:`lever_arms`.
        normal_noise: of a point's information, how much its normal's noise pretends.
        floor_sigmas: ``(6,)`` rad, m: no direction is known better.
        held: ``(6, D)`` directions, orthonormal in the units of :func:`scaled_spectrum`, that have no part in it.
    """
    values, vectors, to_tangent = scaled_spectrum(information, levers_m)
    free = np.ones(6, dtype=bool)
    if held is not None and held.shape[1]:
        values, vectors, free = _without(held, information, to_tangent)
    known = values - normal_noise * np.trace(information[3:, 3:])
    variance = free * np.minimum(scale * sigma_m**2 / np.maximum(known, 1e-9), UNKNOWN_SIGMA_M**2)
    root = vectors * np.sqrt(variance) * to_tangent[:, None]
    return np.asarray(root @ root.T + np.diag(floor_sigmas**2))


def _without(held: Array, information: Array, to_tangent: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Eigenvalues and eigenvectors of the scaled Hessian beside ``held``, and which of them are not held."""
    beside = np.eye(6) - held @ held.T
    values, vectors = np.linalg.eigh(beside @ (information * np.outer(to_tangent, to_tangent)) @ beside)
    return values, vectors, np.abs(held.T @ vectors).max(axis=0, initial=0.0) < _HALF


def newton_step(
    information: Array,
    gradient: Array,
    limit_m: float = np.inf,
    levers_m: Array | None = None,
    normal_noise: float = NORMAL_NOISE.mean,
    held: Array | None = None,
) -> Array:
    """The step ``(6,)`` to the minimum of the quadratic, at most ``limit_m``, and none along degenerate directions.

    ``held`` ``(6, D)``, orthonormal in the units of :func:`scaled_spectrum`, says along which instead; D may be 0.

    (Zhang, Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016.)
    """
    values, vectors, scale = scaled_spectrum(information, levers_m)
    strong = strong_directions(information, values, normal_noise)
    if held is not None:
        values, vectors, strong = _without(held, information, scale)
    inverse = np.where(strong, 1 / np.maximum(values, 1e-12), 0.0)
    reduced = -(vectors @ (inverse * (vectors.T @ (scale * gradient))))
    return np.asarray(scale * reduced * min(1.0, limit_m / max(float(np.linalg.norm(reduced)), 1e-12)))
