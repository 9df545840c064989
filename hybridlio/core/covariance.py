"""The check that every covariance passes where it enters the library."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError

# Asymmetry that rounding explains: float32 input (relative 6e-8, with a margin), and sums of terms that cancel
# (absolute, against the largest entry).
_RELATIVE_ASYMMETRY, _ABSOLUTE_ASYMMETRY = 1e-6, 1e-12


def check_covariance(covariance: ArrayLike, name: str, size: int = 6) -> Array:
    """Return the covariance as a symmetric float64 ``(size, size)`` matrix; asymmetry within rounding is averaged out.

    Args:
        covariance: the matrix.
        name: what it belongs to, for the error message.
        size: number of rows and columns.

    Raises:
        DataError: it has another shape, is not finite, not symmetric or not positive definite.
    """
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise DataError(f"{name}: expected a finite ({size}, {size}) covariance, got shape {matrix.shape}")
    asymmetry, magnitude = np.abs(matrix - matrix.T), np.abs(matrix)
    if (asymmetry > _RELATIVE_ASYMMETRY * magnitude + _ABSOLUTE_ASYMMETRY * magnitude.max()).any():
        raise DataError(f"{name}: covariance is not symmetric")
    matrix = (matrix + matrix.T) / 2
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise DataError(f"{name}: covariance is not positive definite") from None
    return matrix
