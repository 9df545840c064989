"""GTSAM noise models from covariances, standard deviations and robust kernels."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.covariance import check_covariance
from hybridlio.graph.base.kernels import estimator


def gaussian(covariance: Array, name: str) -> gtsam.noiseModel.Base:
    """Return the noise model of a covariance ``(d, d)``; ``name`` is the measurement's, for error messages.

    Raises:
        DataError: the covariance is not finite, not symmetric or not positive definite.
    """
    return gtsam.noiseModel.Gaussian.Covariance(check_covariance(covariance, name, len(covariance)))


def sigmas(values: Array) -> gtsam.noiseModel.Base:
    """Return the noise model of independent standard deviations ``(d,)``."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(values, dtype=np.float64))


def with_kernel(model: gtsam.noiseModel.Base, kernel: str, width: float) -> gtsam.noiseModel.Base:
    """Return the noise model with a robust kernel on it.

    Args:
        model: noise of a correct measurement.
        kernel: one of :data:`KERNELS`; ``dcs`` is dynamic covariance scaling.
        width: norm of the whitened residual up to which a measurement counts in full.
    """
    return gtsam.noiseModel.Robust.Create(estimator(kernel, width), model)
