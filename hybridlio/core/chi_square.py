"""Quantiles of the χ² distribution, by which parts decide whether a residual fits its covariance."""

from __future__ import annotations

from scipy.special import gammaincinv


def chi_square_quantile(share: float, freedom: int) -> float:
    """Return the value below which ``share`` of χ² values of ``freedom`` degrees of freedom lie.

    The inverse of the regularised incomplete gamma function; ``scipy.stats`` gives the same and takes longer to import.
    """
    return float(2 * gammaincinv(freedom / 2, share))
