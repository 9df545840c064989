"""What the loss says of a pose at run time: how good it is, how sure, and where it is lower.

The loss is the one that trained the network, its point-to-plane term (UnDeepLIO, "Loss Function", ``L_po2pl``) in a
robust form whose Hessian weighs the answer. Its clouds are averages of what the maps show, whose normals the network
has already: planes fitted to the whole cloud take longer than all the rest of a step, and lead no nearer to the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.voxel import voxel_average
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.registration.icp import robust_cost
from hybridlio.registration.information import (
    covariance_of,
    degenerate_directions,
    lever_arms,
    newton_step,
    weak_basis,
)
from hybridlio.registration.surface import Neighbours, Surface

Map = NDArray[np.float32]

CHI2_99, _CHI2_90 = 16.8, 10.6  # of six degrees of freedom
_VOXEL_M = 0.4
_LONGEST_STEP_M = 0.5
_UNKNOWN_SIGMA_M = 10.0
_NORMAL_NOISE = 3e-3  # smooth walls were seen to pretend a seventh of this, an open field up to all of it
# The loss's minimum is off, beside noise, by what its clouds are: averages of rings that lie elsewhere in each scan.
# Those on the road decide roll, pitch and height. Rad, m, for a lidar whose rings lie about z.
_SYSTEMATIC = np.diag(np.array([1.5e-4, 1.5e-4, 3e-5, 1.5e-3, 1.5e-3, 6e-4]) ** 2)
# Nearer poses than this are never told apart by the loss alone, whatever its noise.
_INDISTINCT = np.diag(np.r_[np.full(3, 3e-4), np.full(3, 1.5e-3)] ** 2)
# No direction is known better. Heights are left vaguer than simulated scans would have them: real beams' elevations are
# off, and an IMU's word on heaving, which few samples catch, is soon too sure beside them.
_FLOOR_SIGMAS = np.array([2e-5, 2e-5, 2e-5, 3e-4, 3e-4, 1e-3])


@dataclass(frozen=True, eq=False)
class JudgedScan:
    """A scan as the loss takes it: points ``(N, 3)``, and the same with their planes, to be matched to."""

    points: Array
    surface: Surface

    @classmethod
    def of_maps(cls, vertices: Map, normals: Map, threads: int) -> JudgedScan:
        """Averages of what vertex and normal map ``(3, H, W)`` show, of the cells that have a normal."""
        there = normals.any(axis=0)
        averages = voxel_average(vertices[:, there].T, normals[:, there].T, _VOXEL_M)
        points, planes = (np.asarray(part, np.float64) for part in averages)
        return cls(points, Surface(points, planes, threads))


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose and what the loss says of it.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``.
        cost: mean over all points, metres; one without a match costs as much as one infinitely far away.
        matched: share of the points with a match.
        information: ``(6, 6)`` Gauss-Newton Hessian, a match without residual weighing 1.
        levers_m: ``(3,)`` of the points, see :func:`hybridlio.registration.information.lever_arms`.
        step: ``(6,)`` right perturbation to the minimum of the loss's quadratic here.
        sigma_m: standard deviation of the distances to the planes.
        refined: whether the pose is where the loss led.
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
        """``(6, 6)`` of what the points leave open: ``scale·σ²·H⁻¹``, and 10 m along what they do not constrain."""
        loose = self._loose() * _UNKNOWN_SIGMA_M
        known = covariance_of(self.information, self.sigma_m, scale, self.levers_m, _NORMAL_NOISE, _FLOOR_SIGMAS)
        return known + loose @ loose.T

    def covariance(self, scale: float) -> Array:
        """``(6, 6)`` of the pose, from what the points leave open and how far off the minimum of the loss it is.

        The pose and the minimum err by themselves: both by noise, the minimum by what is systematic in it too. How much
        of the way between them is the pose's error follows from these variances, as in a Kalman filter whose pose
        stays where it is: that part of the way counts by its outer product, all of it where they do not explain it. A
        pose that was taken from the minimum errs as that does.
        """
        noise, step = self.noise(scale), self.step
        if self.refined:
            return noise + _SYSTEMATIC + np.outer(step, step)
        if self.is_off(scale):
            return noise + np.outer(step, step)
        gain = noise @ np.linalg.inv(2 * noise + _SYSTEMATIC)
        left = noise - gain @ noise
        return (left + left.T) / 2 + np.outer(gain @ step, gain @ step) + self._loose() @ self._loose().T

    def is_off(self, scale: float) -> bool:
        """Whether the minimum of the loss is farther away than noise and what is systematic in it explain."""
        return bool(self.step @ np.linalg.solve(self.spread(scale), self.step) > _CHI2_90)

    def spread(self, scale: float) -> Array:
        """``(6, 6)`` within which the loss cannot tell poses apart."""
        return self.noise(scale) + _INDISTINCT

    def constrained(self, xi: Array) -> Array:
        """A tangent vector ``(6,)`` without its parts along what the points do not constrain."""
        loose = self._loose()
        inverse = np.r_[self.levers_m, np.ones(3)]
        weights = (loose * inverse[:, None]).T @ (xi * inverse)
        return np.asarray(xi - loose @ weights)

    def _loose(self) -> Array:
        """``(6, D)``: directions that the points do not constrain, each of a metre at the points' lever arms."""
        basis, to_tangent = weak_basis(self.information, self.levers_m, _NORMAL_NOISE)
        return np.asarray(basis * to_tangent[:, None])


class LossJudge:
    """Judges poses ``T_k_k1`` between two scans; neighbours are looked for anew only where points have moved far.

    Args:
        last, current: the scans.
        settings: of the robust loss.
        threads: for the search.
    """

    def __init__(self, last: JudgedScan, current: JudgedScan, settings: NetworkResidualSettings, threads: int) -> None:
        self._points, self._levers_m = current.points, lever_arms(current.points)
        self._neighbours = Neighbours(last.surface, current.points, threads)
        self._settings = settings

    def judge(self, pose: Array) -> Judged:
        """What the loss says of a pose ``(4, 4)``, with matches looked for there."""
        kernel_m, count = self._settings.kernel_m, len(self._points)
        matches = self._neighbours.matches(pose, self._settings.max_distance_m)
        system = matches.system(kernel_m)
        cost_m = kernel_m * robust_cost(system.distances, count, kernel_m)
        sigma_m = float(np.sqrt(system.weights @ system.distances**2 / max(float(system.weights.sum()), 1e-12)))
        step = newton_step(system.hessian, system.gradient, _LONGEST_STEP_M, self._levers_m, _NORMAL_NOISE)
        return Judged(pose, cost_m, len(matches) / count, system.hessian, self._levers_m, step, sigma_m)

    def descend(self, judged: Judged) -> Judged:
        """Go down the loss by Gauss-Newton steps, as long as it falls and its minimum is farther off than noise."""
        for _ in range(self._settings.refine_steps):
            if not judged.is_off(self._settings.covariance_scale):
                break
            tried = self.judge(se3.orthonormalise(judged.pose @ se3.exp(judged.step)))
            if not tried.cost < judged.cost:
                break
            judged = replace(tried, refined=True)
        return judged
