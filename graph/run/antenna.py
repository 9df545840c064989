"""The GPS antenna in the IMU frame, known or as a variable ``o`` of a run's graph."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import O

from hybridlio.core.arrays import Array
from hybridlio.graph.base import noise
from hybridlio.graph.base.marginals import Covariance
from hybridlio.graph.run.calibration_prior import SETTLED, prior_covariance
from hybridlio.graph.run.factor_groups import GroupFactors
from hybridlio.smoothing.calibration import Parameter, undetermined_directions

_NONE: Array = np.empty((0, 3))


class Antenna:
    """The antenna's position, round by round.

    Args:
        stated_m: ``(3,)``.
        sigma_m: standard deviation of that along each axis; None if it is known.
    """

    def __init__(self, stated_m: Array, sigma_m: float | None) -> None:
        self._stated, self._sigma = stated_m, sigma_m
        self.position_m = stated_m
        self._held = _NONE

    @property
    def is_variable(self) -> bool:
        """Whether it is calibrated."""
        return self._sigma is not None

    def add_to(self, group: GroupFactors) -> None:
        """Add the variable and its prior."""
        if self._sigma is not None:
            model = noise.gaussian(prior_covariance(self._sigma, self._held), "prior of the antenna")
            group.values.insert(O(0), self.position_m)
            group.trusted.append(gtsam.PriorFactorPoint3(O(0), self._stated, model))

    def take(self, values: gtsam.Values, covariance: Covariance) -> bool:
        """Take over a round's solution; return whether the change is small against its uncertainty."""
        before, self.position_m = self.position_m, np.array(values.atPoint3(O(0)))
        sigmas = np.sqrt(np.diag(covariance([O(0)])))
        return bool((np.abs(self.position_m - before) <= SETTLED * sigmas).all())

    def hold(self, covariance: Covariance) -> bool:
        """Hold what the motion does not determine as stated from now on; return whether that is new."""
        assert self._sigma is not None
        if not len(self._held):
            self._held = undetermined_directions(covariance([O(0)]), self._sigma)
            return bool(len(self._held))
        return False

    def parameters(self, covariance: Covariance) -> tuple[Parameter, ...]:
        """Return the parameter ``lever_arm``."""
        assert self._sigma is not None
        spread = covariance([O(0)]) + self._sigma**2 * self._held.T @ self._held
        return (Parameter("lever_arm", self.position_m - self._stated, spread, self._sigma, self._held),)
