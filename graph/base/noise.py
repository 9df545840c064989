"""GTSAM noise models from covariances, with one clear error for those that are none."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.covariance import check_covariance


def gaussian(covariance: Array, name: str) -> gtsam.noiseModel.Base:
    """Noise model of a symmetric positive definite covariance; ``name`` says whose in the error.

    Raises:
        DataError: not finite, not symmetric or not positive definite.
    """
    return gtsam.noiseModel.Gaussian.Covariance(check_covariance(covariance, name, len(covariance)))


def sigmas(values: Array) -> gtsam.noiseModel.Base:
    """Noise model of independent standard deviations."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(values, dtype=np.float64))
