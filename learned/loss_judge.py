"""What the loss says of a pose at run time: how good it is, how sure, and where it is lower.

The loss is the one that trained the network, in a robust form whose Hessian weighs the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio import se3
from hybridlio.information import covariance_of, degenerate_directions, newton_step
from hybridlio.learned.correspondences import Clouds, match
from hybridlio.learned.losses import gauss_newton, loss
from hybridlio.learned.settings import LossSettings
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.projection import MapGeometry

Array = NDArray[np.float64]

_LONGEST_STEP_M = 0.5


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose and what the loss says of it.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``.
        cost: mean over all points; one without a match costs as much as one infinitely far away.
        matched: share of the points with a match.
        information: ``(6, 6)`` Gauss-Newton Hessian, a match without residual weighing 1.
        step: ``(6,)`` right perturbation to the minimum of the loss's quadratic here.
        sigma_m: standard deviation of the distances to the planes.
    """

    pose: Array
    cost: float
    matched: float
    information: Array
    step: Array
    sigma_m: float

    @property
    def degenerate(self) -> Array:
        """``(D, 6)`` unit directions that the points do not constrain."""
        return degenerate_directions(self.information)

    def noise(self, scale: float) -> Array:
        """``(6, 6)`` of what the points leave open: ``scale·σ²·H⁻¹``."""
        return covariance_of(self.information, self.sigma_m, scale)

    def covariance(self, scale: float) -> Array:
        """``(6, 6)`` of the pose: what the points leave open, and how far off the minimum it is.

        A network's answer is not the minimum of the loss. The way to it is an error that the loss can see; it is added
        as its outer product.
        """
        return self.noise(scale) + np.outer(self.step, self.step)


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
        # the information is the Hessian times k/2, the Geman-McClure kernel's scale
        step = newton_step(information, gradient * self._kernel_m / 2, _LONGEST_STEP_M)
        cost = share * value + (1 - share) * self._kernel_m
        return Judged(pose, cost, share, information, step, float(near.sigma_m))

    def descend(self, judged: Judged, last: Clouds, current: Clouds, steps: int) -> Judged:
        """Go down the loss by Gauss-Newton steps, as long as it falls."""
        for _ in range(steps):
            tried = self.judge(se3.orthonormalise(judged.pose @ se3.exp(judged.step)), last, current)
            if not tried.cost < judged.cost:
                break
            judged = tried
        return judged


def on_device(values: NDArray[np.float32] | Array, device: torch.device) -> Tensor:
    """Values as a float32 batch of one."""
    return torch.from_numpy(np.asarray(values, np.float32))[None].to(device)
