"""Point-to-plane registration of one scan to a surface, by robust Gauss-Newton steps.

The cost is the unsupervised loss's first term (UnDeepLIO §3.3, ``L_po2pl``) in a robust squared form: with it the
residual network is trained, and its Hessian weighs the between-factor. Correspondences are nearest neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp

from hybridlio import se3
from hybridlio.estimates import Array
from hybridlio.information import lever_arms, newton_step

_ROTATION_CONVERGED_RAD = 2e-5
_TRANSLATION_CONVERGED_M = 3e-4
_REMATCH_ROTATION_RAD = 2e-4  # a centimetre at 50 m
_REMATCH_TRANSLATION_M = 5e-3
_IDENTITY = np.eye(4)
_REMATCH_STEPS = 8  # points between two equally near neighbours would have the pose go to and fro for ever


@dataclass(frozen=True)
class RegistrationSettings:
    """How scans are registered.

    Attributes:
        kernel_m: residual at which the Geman-McClure kernel has pushed a point's weight down to a quarter.
        max_distance_m: nearest neighbours farther away do not count.
        max_iterations: Gauss-Newton steps.
        threads: for the nearest-neighbour search.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    kernel_m: float = 0.1
    max_distance_m: float = 1.0
    max_iterations: int = 15
    threads: int = 2


class Surface:
    """Points with normals and a KD-tree over them: what a scan is registered to.

    Args:
        points: ``(M, 3)`` metres.
        normals: ``(M, 3)`` unit vectors.
        threads: for building the tree.
    """

    def __init__(self, points: Array, normals: Array, threads: int = 2) -> None:
        self.points = points
        self.normals = normals
        self._tree = small_gicp.KdTree(points, threads)

    def nearest(self, queries: Array, threads: int) -> tuple[Array, Array]:
        """Index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        index, distance2 = self._tree.batch_knn_search(queries, 1, threads)
        return index[:, 0].astype(np.int64), distance2[:, 0]


@dataclass(frozen=True, eq=False)
class Registration:
    """The outcome.

    Attributes:
        pose: ``(4, 4)``; maps the scan's points to the surface's frame.
        hessian: ``(6, 6)`` of half the weighted squared residuals at the answer, right perturbation, 1/m² units removed
            (multiply by 1/σ² for information).
        levers_m: ``(3,)`` of the matched points about the scan's axes.
        sigma_m: robust standard deviation of the residuals.
        matched: share of points with a neighbour near enough.
        cost: mean robust cost over all points, between 0 and 1; unmatched points cost 1.
        iterations: steps taken.
        converged: whether the last step was small.
    """

    pose: Array
    hessian: Array
    levers_m: Array
    sigma_m: float
    matched: float
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class _Matches:
    """Which points of the scan lie near which of the surface, at the pose at which they were looked for."""

    pose: Array
    source: Array
    target: Array
    normals: Array
    levers_m: Array


@dataclass(frozen=True, eq=False)
class _Linearisation:
    hessian: Array
    gradient: Array
    residuals: Array
    weights: Array


def _match(surface: Surface, source: Array, pose: Array, reach_m: float, threads: int) -> _Matches:
    index, distance2 = surface.nearest(source @ pose[:3, :3].T + pose[:3, 3], threads)
    near = distance2 < reach_m**2
    index, source = index[near], source[near]
    return _Matches(pose, source, surface.points[index], surface.normals[index], lever_arms(source))


def _linearise(matches: _Matches, pose: Array, kernel_m: float) -> _Linearisation:
    moved = matches.source @ pose[:3, :3].T + pose[:3, 3]
    residuals = np.einsum("ij,ij->i", moved - matches.target, matches.normals)
    weights = (kernel_m**2 / (kernel_m**2 + residuals**2)) ** 2
    normals_in_scan = matches.normals @ pose[:3, :3]
    J = np.hstack([np.cross(matches.source, normals_in_scan), normals_in_scan])
    weighted = J * weights[:, None]
    return _Linearisation(weighted.T @ J, weighted.T @ residuals, residuals, weights)


def _moved(matches: _Matches, pose: Array) -> bool:
    """Whether the pose is so far from where neighbours were looked for that others may be nearer."""
    step = se3.between(matches.pose, pose) - _IDENTITY  # of small steps the logarithm, at a tenth of its cost
    return bool(
        np.abs(step[:3, :3]).max() > _REMATCH_ROTATION_RAD or np.abs(step[:3, 3]).max() > _REMATCH_TRANSLATION_M
    )


def register(
    surface: Surface, source: Array, initial: Array, settings: RegistrationSettings, kernel_start_m: float = 0.0
) -> Registration:
    """Find the pose that lays ``source`` on ``surface``.

    Directions that the points hardly constrain (:func:`hybridlio.information.degenerate_directions`) stay as in
    ``initial``.

    Args:
        surface: points with normals.
        source: ``(N, 3)`` points of the scan, metres.
        initial: ``(4, 4)`` pose to start from.
        settings: kernel, distances, limits.
        kernel_start_m: a wider kernel to begin with, halved at every step; for an uncertain ``initial``.
    """
    pose, kernel, converged, iterations = initial, max(settings.kernel_m, kernel_start_m), False, 0
    matches = _match(surface, source, pose, max(settings.max_distance_m, 3 * kernel), settings.threads)
    while not converged and iterations < settings.max_iterations:
        iterations += 1
        if iterations <= _REMATCH_STEPS and _moved(matches, pose):
            matches = _match(surface, source, pose, max(settings.max_distance_m, 3 * kernel), settings.threads)
        system = _linearise(matches, pose, kernel)
        step = np.zeros(6)
        if len(system.residuals) >= 6:
            step = newton_step(system.hessian, system.gradient, levers_m=matches.levers_m)
        pose = pose @ se3.exp(step)
        small = np.abs(step[:3]).max() < _ROTATION_CONVERGED_RAD and np.abs(step[3:]).max() < _TRANSLATION_CONVERGED_M
        converged = bool(small and kernel == settings.kernel_m)
        kernel = max(settings.kernel_m, kernel / 2)
    return _summary(system, matches, len(source), settings, se3.orthonormalise(pose), iterations, converged)


def cost_at(
    surface: Surface, source: Array, pose: Array, kernel_m: float, threads: int, reach_m: float | None = None
) -> float:
    """Mean robust cost, between 0 and 1, of ``source`` at a pose, without a step from there.

    Points without a neighbour within ``reach_m``, by default three times the kernel, cost 1.
    """
    matches = _match(surface, source, pose, 3 * kernel_m if reach_m is None else reach_m, threads)
    return _cost(_linearise(matches, pose, kernel_m).residuals, len(source), kernel_m)


def _cost(residuals: Array, points: int, kernel_m: float) -> float:
    r2 = residuals**2
    return float((r2 / (kernel_m**2 + r2)).sum() + points - len(r2)) / max(points, 1)


def _summary(
    system: _Linearisation,
    matches: _Matches,
    points: int,
    settings: RegistrationSettings,
    pose: Array,
    iterations: int,
    converged: bool,
) -> Registration:
    r2 = system.residuals**2
    cost = _cost(system.residuals, points, settings.kernel_m)
    weight = max(float(system.weights.sum()), 1e-12)
    sigma = float(np.sqrt((system.weights * r2).sum() / weight))
    matched = len(r2) / max(points, 1)
    return Registration(pose, system.hessian, matches.levers_m, sigma, matched, cost, iterations, converged)
