"""The errors of an odometry's turns: a drift that adds up, and a scatter that the next step takes back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded

from hybridlio.core.arrays import Array, Mask

_LEAST_DRIFT_SHARE = 0.05  # of a step's variance: steps that scatter alone would fix all turns over a whole run
LEAST_SIGMA_RAD = 1e-5  # of a step: below a lidar's and a gyroscope's resolution; keeps noise-free data solvable


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Variances ``(3,)`` per axis of an odometry's turns: a step has ``drift + 2·scatter``, neighbours ``-scatter``."""

    drift: Array
    scatter: Array

    @classmethod
    def of(cls, residuals: Array, measured: Mask, joined: Mask) -> StepNoise:
        """Estimate both from residuals by their variance and the covariance of joined neighbours.

        Args:
            residuals: ``(N, 3)``, 0 where not measured.
            measured: ``(N, 3)``.
            joined: ``(N-1, 3)``.
        """
        variance = mean_square(residuals, measured) + LEAST_SIGMA_RAD**2
        pairs = (residuals[1:] * residuals[:-1] * joined).sum(axis=0) / np.maximum(joined.sum(axis=0), 1)
        scatter = np.clip(-pairs, 0.0, (1 - _LEAST_DRIFT_SHARE) * variance / 2)
        return cls(variance - 2 * scatter, scatter)

    def whitened(self, joined: Mask, columns: Array) -> Array:
        """Return columns ``(N, 3, C)``, multiplied by the inverse Cholesky factor of the residuals' covariance."""
        out = np.empty_like(columns)
        for axis in range(3):
            bands = np.zeros((2, len(columns)))
            bands[0] = self.drift[axis] + 2 * self.scatter[axis]
            bands[1, :-1] = np.where(joined[:, axis], -self.scatter[axis], 0.0)
            factor = cholesky_banded(bands, lower=True)
            out[:, axis] = solve_banded((1, 0), factor, columns[:, axis])
        return out


def mean_square(values: Array, measured: Mask) -> Array:
    """Return the mean squares ``(3,)`` of those of the values ``(N, 3)`` that are measured; 0 for none."""
    return np.asarray((values**2).sum(axis=0) / np.maximum(measured.sum(axis=0), 1))
