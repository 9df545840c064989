"""Weights of graduated non-convexity (GNC) with truncated least squares.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020, section IV.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile

_INLIER_SHARE = 0.99  # share of correct measurements below the bound, as in GTSAM's GncOptimizer
GRADUATION = 1.4  # factor by which the control parameter grows at every step; the paper's


def chi2_bound(size: int) -> float:
    """Return the χ² of ``size`` degrees of freedom that 99 % of correct measurements stay below."""
    return chi_square_quantile(_INLIER_SHARE, size)


def first_control(largest_chi2: float, bound: float) -> float:
    """Return the control parameter to start from, at which the cost is convex up to the largest χ² (section IV)."""
    return bound / max(2 * largest_chi2 - bound, bound)


def truncated_weights(chi2: Array, bound: float, control: float) -> Array:
    """Return weights ``(M,)`` of truncated least squares at a control parameter (Yang et al., eq. 14).

    Args:
        chi2: ``(M,)`` squared whitened residuals.
        bound: χ² at which a measurement is truncated.
        control: the paper's μ; it grows from nearly 0 (convex) to infinity (truncated least squares).
    """
    between = np.sqrt(bound * control * (control + 1) / np.maximum(chi2, 1e-12 * bound)) - control
    weights = np.where(chi2 >= bound * (control + 1) / control, 0.0, between)
    return np.where(chi2 <= bound * control / (control + 1), 1.0, weights)
