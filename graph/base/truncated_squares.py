"""Graduated non-convexity (GNC) with truncated least squares: its weights, and its loop.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020, section IV.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.chi_square import chi_square_quantile

_INLIER_SHARE = 0.99  # share of correct measurements below the bound, as in GTSAM's GncOptimizer
GRADUATION = 1.4  # factor by which the control parameter grows at every step; the paper's
_MAX_STEPS = 200  # 1.4^200 is 1e29: all weights are 0 or 1 long before

State = TypeVar("State")


def graduate(
    state: State, chi2: Callable[[State], Array], solve: Callable[[State, Array], State], bound: float, *,
    growth: float = GRADUATION, largest: float = np.inf, held: Mask | None = None,
) -> tuple[State, Array]:  # fmt: skip
    """Weigh measurements and solve in turn, until every weight is 0 or 1 (section IV).

    GTSAM's ``GncOptimizer`` solves every step from the first values, and weighs pose graphs alone; this starts each
    step from the last one, and serves any solver.

    Args:
        state: to start from.
        chi2: returns the measurements' squared whitened residuals ``(M,)`` at a state.
        solve: returns the state with weights ``(M,)``, from a state near it.
        bound: χ² up to which a measurement counts as correct.
        growth: factor by which the control parameter grows at every step.
        largest: χ² from which graduation starts at most, in units of the bound.
        held: ``(M,)`` measurements that keep their full weight.

    Returns:
        The state, from before the last weights, and the weights ``(M,)``.
    """
    control, weights = 0.0, np.zeros(0)
    for step in range(_MAX_STEPS):
        squares = chi2(state)
        if (squares <= bound).all():  # the cost is not truncated anywhere
            weights = np.ones(len(squares))
            break
        first = min(float(squares.max(initial=0.0)), largest * bound)
        control = control * growth if step else first_control(first, bound)
        weights = truncated_weights(squares, bound, control)
        weights = weights if held is None else np.where(held, 1.0, weights)
        if ((weights == 0) | (weights == 1)).all():
            break
        state = solve(state, weights)
    return state, weights


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
