"""What the loss says of a pose at run time: how good it is, how sure, and where it is lower.

The loss is the one that trained the network, in a robust form whose Hessian weighs the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio import se3
from hybridlio.information import (
    covariance_of,
    degenerate_directions,
    lever_arms,
    newton_step,
    weak_basis,
)
from hybridlio.learned.correspondences import Clouds, match
from hybridlio.learned.losses import gauss_newton, loss
from hybridlio.learned.settings import LossSettings
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.projection import MapGeometry

Array = NDArray[np.float64]

CHI2_99, _CHI2_90 = 16.8, 10.6  # of six degrees of freedom
_LONGEST_STEP_M = 0.5
_UNKNOWN_SIGMA_M = 10.0
_NORMAL_NOISE = 5e-3  # planes of one scan, averaged over voxels, are noisier than those of a map
# The loss's minimum is off, beside noise, by what its clouds are: averages of rings that lie elsewhere in each scan.
# Those on the road decide roll, pitch and height. Rad, m, for a lidar whose rings lie about z.
_SYSTEMATIC = np.diag(np.array([3e-4, 3e-4, 3e-5, 1.5e-3, 1.5e-3, 1.2e-3]) ** 2)
# Nearer poses than this are never told apart by the loss alone, whatever its noise.
_INDISTINCT = np.diag(np.r_[np.full(3, 3e-4), np.full(3, 1.5e-3)] ** 2)
# No direction is known better. Heights are left vaguer than simulated scans would have them: real beams' elevations are
# off, and an IMU's word on heaving, which few samples catch, is soon too sure beside them.
_FLOOR_SIGMAS = np.array([2e-5, 2e-5, 2e-5, 3e-4, 3e-4, 1e-3])


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose and what the loss says of it.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``.
        cost: mean over all points; one without a match costs as much as one infinitely far away.
        matched: share of the points with a match.
        information: ``(6, 6)`` Gauss-Newton Hessian, a match without residual weighing 1.
        levers_m: ``(3,)`` of the points, see :func:`hybridlio.information.lever_arms`.
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
    """Judges poses between two scans' clouds."""

    def __init__(self, settings: NetworkResidualSettings, geometry: MapGeometry, device: torch.device) -> None:
        self._geometry, self._device = geometry, device
        self._kernel_m = settings.kernel_m
        self._loss = LossSettings(
            kernel="geman-mcclure",
            kernel_m=settings.kernel_m,
            max_distance_m=settings.max_distance_m,
            reduction="mean",
        )

    def judge(self, pose: Array, last: Clouds, current: Clouds) -> Judged:
        """What the loss says of ``T_k_k1`` ``(4, 4)``, with matches looked for there."""
        with torch.no_grad():
            T = torch.from_numpy(np.asarray(pose, np.float32))[None].to(self._device)
            matches = match(T, last, current, self._loss, self._geometry)
            value, share = float(loss(matches, T, self._loss).total), float(matches.share)
            near = gauss_newton(matches, T, self._loss)
        information, gradient = (x[0].double().cpu().numpy() for x in (near.information, near.gradient))
        levers_m = lever_arms(current.points[current.there].double().cpu().numpy())
        # the information is the Hessian times k/2, the Geman-McClure kernel's scale
        step = newton_step(information, gradient * self._kernel_m / 2, _LONGEST_STEP_M, levers_m, _NORMAL_NOISE)
        cost = share * value + (1 - share) * self._kernel_m
        return Judged(pose, cost, share, information, levers_m, step, float(near.sigma_m))

    def descend(self, judged: Judged, last: Clouds, current: Clouds, steps: int, scale: float) -> Judged:
        """Go down the loss by Gauss-Newton steps, as long as it falls and its minimum is farther off than noise."""
        for _ in range(steps):
            if not judged.is_off(scale):
                break
            tried = self.judge(se3.orthonormalise(judged.pose @ se3.exp(judged.step)), last, current)
            if not tried.cost < judged.cost:
                break
            judged = replace(tried, refined=True)
        return judged


def on_device(values: NDArray[np.float32] | Array, device: torch.device) -> Tensor:
    """Values as a float32 batch of one."""
    return torch.from_numpy(np.asarray(values, np.float32))[None].to(device)
