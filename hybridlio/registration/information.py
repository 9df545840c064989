"""Covariance, degenerate directions and Gauss-Newton step of a pose, from the Hessian of its point-to-plane matches.

Shared by scan matching and the network, whose loss is the same. Every Hessian here is ``(6, 6)``, rotation first, of
half the weighted squared distances to planes, for a right perturbation ``T·Exp(ξ)``:

    ``H = Σ wᵢ Jᵢᵀ Jᵢ``,  ``Jᵢ = [(pᵢ × Rᵀnᵢ)ᵀ, (Rᵀnᵢ)ᵀ]``,

with point ``p`` in the scan's frame, unit normal ``n`` and robust weight ``w`` (:mod:`hybridlio.registration.surface`).

**One unit for rotation and translation.** Eigenvalues can be compared only in one unit. A rotation of one radian about
an axis moves points by their lever arm about it, so the rotation columns are divided by the root mean square lever
arms. All eigenvalues then count points: the trace of the translation block is ``Σ wᵢ``, as normals have length 1.

**Spurious information.** Normals are estimates. One that is tilted by ``ε`` contributes ``wᵢ·ε²`` along directions in
its own plane, where an exact one contributes nothing; after the scaling the same holds for rotations. The share ``ε²``
of all information, :class:`NormalNoise`, is therefore subtracted before an eigenvalue becomes a variance, and a
direction counts as constrained only where its eigenvalue exceeds three times that share.

**Covariance.** With independent residuals of variance ``σ²`` the Gauss-Newton minimum has covariance ``σ²·H⁻¹``.
Neighbouring points lie on the same plane and share its error, so ``N`` of them are worth only ``N / scale`` independent
ones: the covariance is ``scale·σ²·H⁻¹``. The callers' scales are tuned on normalised errors (ANEES) of drives with a
reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import MEASUREMENT_FLOOR_SIGMAS


class NormalNoise(NamedTuple):
    """Mean square tilt of estimated normals, rad²: the share of all information that is spurious in any direction.

    Attributes:
        mean: average share. It is subtracted from every eigenvalue before that becomes a variance.
        largest: share on surfaces where tilts do not average out, such as the edges of smooth walls. Directions with
            less than three times this are weak: either spurious, or constrained by few objects.
    """

    mean: float
    largest: float


# Planes of equal weight. The tilt is 0.045 rad. Edges of smooth walls (benchmarks/scenarios.py, corridor, seed 7402)
# reached an eigenvalue of 0.019 of all information; 3 · 8e-3 is above that, and below what road scenes have.
NORMAL_NOISE = NormalNoise(2e-3, 8e-3)
# Planes weighted by their thickness: 0.035 rad, as the worst normals belong to thick planes. The edges are no better.
NORMAL_NOISE_WEIGHTED = NormalNoise(1.2e-3, 8e-3)
_STRONG_RATIO = 3  # times the normal noise, so that the corrected information is at least two thirds of the measured
# Along unconstrained directions: far more than a step's error, yet well conditioned in the graph.
UNKNOWN_SIGMA_M = 10.0
_HALF = 0.5  # after projection an eigenvector lies in the fixed subspace (1) or orthogonal to it (0)


def lever_arms(points: Array) -> Array:
    """Return the ``(3,)`` root mean square distances, metres, of points ``(N, 3)`` from the x, y and z axes."""
    from hybridlio.registration import match_loops  # late: compiled

    return match_loops.lever_arms(points)


def scaled_spectrum(hessian: Array, lever_arms_m: Array | None = None) -> tuple[Array, Array, Array]:
    """Return eigenvalues and eigenvectors of a Hessian whose rotations are measured in metres.

    One lever arm per axis matters in elongated scenes: in a corridor the lever arm of yaw is the corridor's length,
    that of roll its width. A common one would make roll look unconstrained.

    Args:
        hessian: ``(6, 6)``.
        lever_arms_m: ``(3,)`` of :func:`lever_arms`; by default one for all axes, from the ratio of the two traces.

    Returns:
        eigenvalues ``(6,)`` in ascending order, eigenvectors as columns ``(6, 6)``, and the scale ``(6,)`` by which a
        vector in these units is multiplied to become a tangent vector (rad, m).
    """
    scale = scale_of(_mean_lever(hessian) if lever_arms_m is None else lever_arms_m)
    values, vectors = np.linalg.eigh(hessian * (scale[:, None] * scale))
    return values, vectors, scale


def _mean_lever(hessian: Array) -> Array:
    """Return the same lever arm for all axes ``(3,)``, from the ratio of the traces."""
    mean = np.sqrt(max(np.trace(hessian[:3, :3]), 1e-12) / max(np.trace(hessian[3:, 3:]), 1e-12))
    return np.full(3, mean)


def strong_directions(hessian: Array, values: Array, normal_noise: float = NORMAL_NOISE.mean) -> NDArray[np.bool_]:
    """Return which eigenvalues ``(6,)`` of :func:`scaled_spectrum` cannot be explained by noisy normals alone."""
    strong: NDArray[np.bool_] = values >= _STRONG_RATIO * normal_noise * np.trace(hessian[3:, 3:])
    return strong


def weak_basis(
    hessian: Array, lever_arms_m: Array | None = None, normal_noise: float = NORMAL_NOISE.mean
) -> tuple[Array, Array]:
    """Return an orthonormal basis ``(6, D)`` of the weak directions in scaled units, and their scale ``(6,)``."""
    values, vectors, scale = scaled_spectrum(hessian, lever_arms_m)
    return np.asarray(vectors[:, ~strong_directions(hessian, values, normal_noise)]), scale


def degenerate_directions(
    hessian: Array, lever_arms_m: Array | None = None, normal_noise: float = NORMAL_NOISE.mean
) -> Array:
    """Return ``(D, 6)`` unit tangent directions along which the information may be spurious."""
    basis, to_tangent = weak_basis(hessian, lever_arms_m, normal_noise)
    directions = (basis * to_tangent[:, None]).T
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def covariance_of(
    hessian: Array,
    sigma_m: float,
    scale: float,
    lever_arms_m: Array | None = None,
    normal_noise: float = NORMAL_NOISE.mean,
    floor_sigmas: Array = MEASUREMENT_FLOOR_SIGMAS,
    fixed: Array | None = None,
) -> Array:
    """Return the covariance ``scale·σ²·H⁻¹`` ``(6, 6)``, rad² and m², rotation first.

    The spurious information is subtracted from each eigenvalue first. Where nothing is left the standard deviation is
    :data:`UNKNOWN_SIGMA_M` (for rotations: that, divided by the lever arm).

    Args:
        hessian: ``(6, 6)``.
        sigma_m: standard deviation of the distances to the planes.
        scale: ratio to the covariance of independent residuals.
        lever_arms_m: ``(3,)`` of :func:`lever_arms`.
        normal_noise: spurious share of the information, see :class:`NormalNoise`.
        floor_sigmas: ``(6,)`` rad, m, added in quadrature: errors that no number of points averages out.
        fixed: ``(6, D)`` directions with no part in the result, orthonormal in the units of :func:`scaled_spectrum`.
    """
    values, vectors, to_tangent = scaled_spectrum(hessian, lever_arms_m)
    free = np.ones(6, dtype=bool)
    if fixed is not None and fixed.shape[1]:
        values, vectors, free = _without(fixed, hessian, to_tangent)
    information = values - normal_noise * np.trace(hessian[3:, 3:])
    variance = free * np.minimum(scale * sigma_m**2 / np.maximum(information, 1e-9), UNKNOWN_SIGMA_M**2)
    root = vectors * np.sqrt(variance) * to_tangent[:, None]
    return np.asarray(root @ root.T + np.diag(floor_sigmas**2))


def newton_step(
    hessian: Array,
    gradient: Array,
    limit_m: float = np.inf,
    lever_arms_m: Array | None = None,
    normal_noise: float = NORMAL_NOISE.mean,
    fixed: Array | None = None,
) -> Array:
    """Return the Gauss-Newton step ``(6,)`` within the strong directions (solution remapping).

    Source: Zhang, Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016. A full step
    would divide noise of the gradient by a tiny eigenvalue and slide along a wall.

    Args:
        hessian, gradient: of the matches.
        limit_m: longest step, in the units of :func:`scaled_spectrum`.
        lever_arms_m: ``(3,)`` of :func:`lever_arms`.
        normal_noise: spurious share of the information, which decides what is strong.
        fixed: ``(6, D)`` orthonormal directions, in the units of :func:`scaled_spectrum`, that are left out instead of
            the weak ones; D may be 0.
    """
    from hybridlio.registration import loops  # late: compiled

    scale = scale_of(_mean_lever(hessian) if lever_arms_m is None else lever_arms_m)
    free = loops.Free(scale[:, None] * free_basis(fixed), least_share(normal_noise, fixed))
    step = loops.newton_step(np.ascontiguousarray(hessian), np.ascontiguousarray(gradient), free)
    return np.asarray(step * min(1.0, limit_m / max(float(np.linalg.norm(step / scale)), 1e-12)))


def free_basis(fixed: Array | None) -> Array:
    """Return an orthonormal basis ``(6, K)`` of the directions that are not fixed, in scaled units."""
    if fixed is None or not fixed.shape[1]:
        return np.eye(6)
    return np.ascontiguousarray(np.linalg.svd(fixed)[0][:, fixed.shape[1] :])


def least_share(normal_noise: float, fixed: Array | None) -> float:
    """Return the share of the information that a direction must have in a step of :func:`newton_step`."""
    return _STRONG_RATIO * normal_noise if fixed is None else -np.inf


def scale_of(lever_arms_m: Array) -> Array:
    """Return the scale ``(6,)`` of :func:`scaled_spectrum`."""
    scale = np.ones(6)
    scale[:3] /= lever_arms_m
    return scale


def _without(fixed: Array, hessian: Array, to_tangent: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the scaled Hessian's spectrum in the complement of ``fixed``, and which vectors lie there."""
    complement = np.eye(6) - fixed @ fixed.T
    values, vectors = np.linalg.eigh(complement @ (hessian * (to_tangent[:, None] * to_tangent)) @ complement)
    return values, vectors, np.abs(fixed.T @ vectors).max(axis=0, initial=0.0) < _HALF
