"""Priors of calibrated parameters, which may hold directions that the motion does not determine."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array

_HELD = 1e-4  # of the prior's standard deviation: of directions that are held at it
SETTLED = 0.1  # of the standard deviations, by which a round's changes no longer matter


def prior_covariance(sigma: float, held: Array) -> Array:
    """Return the covariance ``(d, d)`` of a prior of ``d`` components that holds the directions ``(u, d)``."""
    loose = np.eye(held.shape[1]) - held.T @ held
    covariance = sigma**2 * (loose + _HELD**2 * held.T @ held)
    return np.asarray((covariance + covariance.T) / 2)
