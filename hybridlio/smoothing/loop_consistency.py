"""Selection of loop closures that agree with odometry and with one another.

Two loops and the two stretches of odometry between their ends form a cycle, whose composed poses must give identity.
The largest set of loops that agree pairwise is kept (Mangelson, Dominic, Eustice, Vasudevan, "Pairwise consistent
measurement set maximization for robust multi-robot map merging", ICRA 2018). The paper solves a maximum clique problem;
here the set is grown greedily.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.core.setting_checks import check_not_negative, check_positive, check_setting
from hybridlio.smoothing.step_uncertainty import OdometryChain

# Sets that are grown, from the loops that agree with most others. In random graphs of 11 loops the largest is then
# missed at most once in 20 (tests/hybridlio/smoothing/test_loop_consistency.py).
_SEEDS = 32


@dataclass(frozen=True)
class ConsistencySettings:
    """When loops are consistent.

    Attributes:
        inlier_share: share of correct loops whose χ² stays below the bound.
        odometry_scale: factor on odometry's covariances; 4 allows for errors of twice the claimed size, such as those
            that consecutive steps share.
        support_reach_m: a loop needs another one that agrees with it, both of whose ends are this near along the path.
        min_support_gap_m: at least one end of that other loop must be this far away along the path, so that it is of
            other scans.

    Raises:
        SettingError: a value is out of range.
    """

    inlier_share: float = 0.999
    odometry_scale: float = 4.0
    support_reach_m: float = 30.0
    min_support_gap_m: float = 1.0

    def __post_init__(self) -> None:
        check_setting(self, "inlier_share", 0 < self.inlier_share < 1, "above 0 and below 1")
        check_positive(self, "odometry_scale")
        check_not_negative(self, "support_reach_m", "min_support_gap_m")


@dataclass(frozen=True, eq=False)
class LoopArrays:
    """Loops as arrays.

    Attributes:
        earlier, later: ``(M,)`` rows of the run.
        poses: ``(M, 4, 4)`` ``T_earlier_later``.
        covariances: ``(M, 6, 6)``.
    """

    earlier: Index
    later: Index
    poses: Array
    covariances: Array


class Odometry(Protocol):
    """Relative poses along odometry, with covariances of right perturbations."""

    def relative(self, i: Index, j: Index) -> Array:
        """Return ``T_i_j`` ``(…, 4, 4)``."""
        ...

    def covariance(self, i: Index, j: Index) -> Array:
        """Return the covariance ``(…, 6, 6)`` of :meth:`relative`."""
        ...


class TravelledOdometry(Odometry, Protocol):
    """Odometry that also knows distances along the path."""

    @property
    def travelled_m(self) -> Array:
        """``(N,)`` distance travelled to each row."""
        ...


def odometry_chi2(loops: LoopArrays, chain: OdometryChain, scale: float) -> Array:
    """Return χ² ``(M,)`` of the difference between each loop and odometry, with odometry's covariances scaled."""
    predicted = chain.relative(loops.earlier, loops.later)
    covariance = scale * chain.covariance(loops.earlier, loops.later) + loops.covariances
    return _chi2(se3.log(se3.between(predicted, loops.poses)), covariance)


def pairwise_chi2(loops: LoopArrays, chain: Odometry, scale: float) -> Array:
    """Return χ² ``(M, M)`` of the cycle of each pair of loops, symmetric, with odometry's covariances scaled."""
    out = np.zeros((len(loops.earlier), len(loops.earlier)))
    for a in range(len(out) - 1):
        rest = np.arange(a + 1, len(out))
        out[a, rest] = out[rest, a] = cycle_chi2(loops, np.full(len(rest), a), rest, chain, scale)
    return out


def cycle_chi2(loops: LoopArrays, a: Index, b: Index, chain: Odometry, scale: float) -> Array:
    """Return χ² ``(K,)`` of cycles: loop ``a``, odometry to the later end of ``b``, back along ``b`` and to the start.

    The covariance of the composed pose sums those of its four parts, each rotated into the frame at the end.

    Args:
        loops: ``M`` of them.
        a, b: ``(K,)`` indices of the two loops of each cycle.
        chain: odometry between the ends of loops.
        scale: factor on odometry's covariances.
    """
    ahead = chain.relative(loops.later[a], loops.later[b])
    back = chain.relative(loops.earlier[b], loops.earlier[a])
    homeward = se3.inverse(loops.poses[b]) @ back
    error = se3.log(loops.poses[a] @ ahead @ homeward)
    covariance = (
        se3.rotate_covariance(loops.covariances[a], se3.inverse(ahead @ homeward))
        + se3.rotate_covariance(scale * chain.covariance(loops.later[a], loops.later[b]), se3.inverse(homeward))
        + se3.rotate_covariance(loops.covariances[b], se3.inverse(homeward))
        + scale * chain.covariance(loops.earlier[b], loops.earlier[a])
    )
    return _chi2(error, covariance)


def _chi2(errors: Array, covariances: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))


def supported(loops: LoopArrays, agree: Mask, travelled_m: Array, settings: ConsistencySettings) -> Mask:
    """Return which loops ``(M,)`` have another one nearby that agrees with them.

    Args:
        loops: ``M`` of them.
        agree: ``(M, M)`` whether two loops agree.
        travelled_m: ``(N,)`` distance along the path of each row of the run.
        settings: what is nearby.
    """
    gaps = [np.abs(np.subtract.outer(travelled_m[rows], travelled_m[rows])) for rows in (loops.earlier, loops.later)]
    farther = np.maximum(*gaps)
    near = (farther <= settings.support_reach_m) & (farther >= settings.min_support_gap_m)
    return np.asarray((near & agree).any(axis=1))


def largest_consistent_set(agree: Mask) -> Mask:
    """Return which loops ``(M,)`` are in the largest set found in which all agree pairwise.

    Args:
        agree: ``(M, M)``, symmetric.
    """
    agree = agree & ~np.eye(len(agree), dtype=bool)
    best = np.zeros(len(agree), bool)
    for seed in np.argsort(-agree.sum(axis=1), kind="stable")[:_SEEDS]:
        grown = _grown(agree, int(seed))
        best = grown if grown.sum() > best.sum() else best
    return best


def _grown(agree: Mask, seed: int) -> Mask:
    """Grow a set: of the loops that agree with all of it, add the one that agrees with most others; repeat."""
    taken = np.zeros(len(agree), bool)
    taken[seed] = True
    left = agree[seed].copy()
    while left.any():
        degrees = np.where(left, agree[:, left].sum(axis=1), -1)
        chosen = int(degrees.argmax())
        taken[chosen] = True
        left &= agree[chosen]
    return taken
