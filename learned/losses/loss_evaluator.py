"""The loss at run time: the cost and covariance of a pose between two scans, and the step to the minimum.

This is the point-to-plane term of the training loss (UnDeepLIO, "Loss Function", ``L_po2pl``) with a robust kernel. Its
clouds are voxel means of the points in the vertex maps, with the normals of the normal maps. Planes fitted to the full
cloud would take longer than the rest of a step and bring the minimum no closer to the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.voxel import voxel_average
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.registration.information import (
    covariance_of,
    degenerate_directions,
    lever_arms,
    newton_step,
    weak_basis,
)
from hybridlio.registration.surface import Neighbours, Surface

Map = NDArray[np.float32]

CHI2_99, _CHI2_90 = 16.8, 10.6  # quantiles of χ² with six degrees of freedom
_VOXEL_M = 0.4  # leaves a few thousand points a scan: means and tree take 4 ms, several times less than for all cells
_LONGEST_STEP_M = 0.5  # half of max_distance_m: after a longer step the matches at the old pose are invalid
_UNKNOWN_SIGMA_M = 10.0  # marks a direction as unknown: larger than the error of a step by any other source
# Share of information that noisy normals add along a plane (rad²). Smooth walls showed a seventh of it, an open field
# up to all of it.
_NORMAL_NOISE = 3e-3
# Covariance of the minimum's systematic error: the clouds are means of scan rings, which lie elsewhere in each scan.
# Rings on the road determine roll, pitch and height. Rad and m, for a lidar that spins about z.
_SYSTEMATIC = np.diag(np.array([1.5e-4, 1.5e-4, 3e-5, 1.5e-3, 1.5e-3, 6e-4]) ** 2)
# Poses closer together than this (0.02°, 1.5 mm) have equal loss within its systematic error; compare _SYSTEMATIC.
_INDISTINCT = np.diag(np.r_[np.full(3, 3e-4), np.full(3, 1.5e-3)] ** 2)
# Lower limits of the standard deviations (rad, m). Height has a larger one than simulated scans would need: elevations
# of real beams are off, and a too certain height makes the graph trust the IMU's few samples of heave.
_FLOOR_SIGMAS = np.array([2e-5, 2e-5, 2e-5, 3e-4, 3e-4, 1e-3])


@dataclass(frozen=True, eq=False)
class LossScan:
    """A scan for the loss: points ``(N, 3)``, and the same points with their planes as a target of matches."""

    points: Array
    surface: Surface

    @classmethod
    def of_maps(cls, vertices: Map, normals: Map, threads: int) -> LossScan:
        """Average the cells of a vertex and a normal map ``(3, H, W)`` that have a normal, over voxels."""
        there = normals.any(axis=0)
        averages = voxel_average(vertices[:, there].T, normals[:, there].T, _VOXEL_M)
        points, planes = (np.asarray(part, np.float64) for part in averages)
        return cls(points, Surface(points, planes, threads))


@dataclass(frozen=True, eq=False)
class EvaluatedPose:
    """A pose with the loss and its derivatives there.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``.
        cost: mean over all points, in metres; a point without a match costs as much as one infinitely far away.
        matched: share of the points with a match.
        information: ``(6, 6)`` Gauss-Newton Hessian, in which a match without residual has the weight 1.
        levers_m: ``(3,)`` lever arms of the points, see :func:`hybridlio.registration.information.lever_arms`.
        step: ``(6,)`` right perturbation that leads to the minimum of the quadratic approximation.
        sigma_m: standard deviation of the distances to the planes.
        refined: whether the pose is the result of a step down the loss.
    """

    pose: Array
    cost: float
    matched: float
    information: Array
    levers_m: Array
    step: Array
    sigma_m: float
    refined: bool = False

    @property
    def degenerate(self) -> Array:
        """``(D, 6)`` unit directions that the points do not constrain."""
        return degenerate_directions(self.information, self.levers_m, _NORMAL_NOISE)

    def noise(self, scale: float) -> Array:
        """Return the covariance ``(6, 6)`` by noise: ``scale·σ²·H⁻¹``, and 10 m along unconstrained directions."""
        free = self._unconstrained() * _UNKNOWN_SIGMA_M
        known = covariance_of(self.information, self.sigma_m, scale, self.levers_m, _NORMAL_NOISE, _FLOOR_SIGMAS)
        return known + free @ free.T

    def covariance(self, scale: float) -> Array:
        """Return the covariance ``(6, 6)`` of the pose, from noise and the distance to the minimum of the loss.

        Pose and minimum are two estimates with separate errors: noise in both, and the systematic error of the minimum.
        As in a Kalman filter, these covariances determine which part of the step between them is the pose's error. The
        pose stays, so that part enters by its outer product; all of the step does where the covariances do not explain
        it. A refined pose has the errors of the minimum.
        """
        noise, step = self.noise(scale), self.step
        if self.refined:
            return noise + _SYSTEMATIC + np.outer(step, step)
        if self.is_off(scale):
            return noise + np.outer(step, step)
        gain = noise @ np.linalg.inv(2 * noise + _SYSTEMATIC)
        left = noise - gain @ noise
        return (
            (left + left.T) / 2 + np.outer(gain @ step, gain @ step) + self._unconstrained() @ self._unconstrained().T
        )

    def is_off(self, scale: float) -> bool:
        """Return whether the minimum is farther away than noise and the systematic error explain, at 90 %."""
        return bool(self.step @ np.linalg.solve(self.spread(scale), self.step) > _CHI2_90)

    def spread(self, scale: float) -> Array:
        """Return the covariance ``(6, 6)`` within which the loss does not distinguish poses."""
        return self.noise(scale) + _INDISTINCT

    def constrained(self, xi: Array) -> Array:
        """Return a tangent vector ``(6,)`` without its components along unconstrained directions."""
        free = self._unconstrained()
        inverse = np.r_[self.levers_m, np.ones(3)]
        weights = (free * inverse[:, None]).T @ (xi * inverse)
        return np.asarray(xi - free @ weights)

    def _unconstrained(self) -> Array:
        """Return the unconstrained directions as columns ``(6, D)``, each of 1 m at the lever arms of the points."""
        basis, to_tangent = weak_basis(self.information, self.levers_m, _NORMAL_NOISE)
        return np.asarray(basis * to_tangent[:, None])


class LossEvaluator:
    """Evaluates poses ``T_k_k1`` between two scans. Neighbours are searched again only for points that moved far.

    Args:
        last, current: the scans.
        settings: kernel and limit of the loss, covariance scale, number of refinement steps.
        threads: for the search.
    """

    def __init__(self, last: LossScan, current: LossScan, settings: NetworkResidualSettings, threads: int) -> None:
        self._points, self._levers_m = current.points, lever_arms(current.points)
        self._neighbours = Neighbours(last.surface, current.points, threads)
        self._settings = settings

    def evaluate(self, pose: Array) -> EvaluatedPose:
        """Evaluate the loss at a pose ``(4, 4)``, with matches searched there."""
        kernel_m, count = self._settings.kernel_m, len(self._points)
        matches = self._neighbours.matches(pose, self._settings.max_distance_m)
        system = matches.system(kernel_m)
        cost_m = kernel_m * (system.cost + count - len(matches)) / count
        sigma_m = float(np.sqrt(system.squares / max(system.weight, 1e-12)))
        step = newton_step(system.hessian, system.gradient, _LONGEST_STEP_M, self._levers_m, _NORMAL_NOISE)
        return EvaluatedPose(pose, cost_m, len(matches) / count, system.hessian, self._levers_m, step, sigma_m)

    def refine(self, found: EvaluatedPose) -> EvaluatedPose:
        """Take Gauss-Newton steps while the loss falls and its minimum is farther away than noise explains."""
        for _ in range(self._settings.refine_steps):
            if not found.is_off(self._settings.covariance_scale):
                break
            tried = self.evaluate(se3.orthonormalise(found.pose @ se3.exp(found.step)))
            if not tried.cost < found.cost:
                break
            found = replace(tried, refined=True)
        return found
