"""Which loop closures agree with odometry and with one another.

Two loops and the two stretches of odometry between their ends make a cycle, which must come back to where it began;
the largest set of loops that agree pair by pair is kept (Mangelson, Dominic, Eustice, Vasudevan, "Pairwise consistent
measurement set maximization for robust multi-robot map merging", ICRA 2018). The set is found greedily.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.core.setting_checks import check_not_negative, check_positive, check_setting
from hybridlio.smoothing.step_uncertainty import OdometryChain


@dataclass(frozen=True)
class ConsistencySettings:
    """When loops agree.

    Attributes:
        inlier_share: of right loops whose χ² stays below the bound.
        odometry_scale: how much larger odometry's covariances are taken to be than they claim.
        witness_m: a loop needs another one, both of whose ends are this near along the path, that agrees with it.
        least_apart_m: and at least one of whose ends is this far.

    Raises:
        SettingError: a value is out of range.
    """

    inlier_share: float = 0.999
    odometry_scale: float = 4.0
    witness_m: float = 30.0
    least_apart_m: float = 1.0

    def __post_init__(self) -> None:
        check_setting(self, "inlier_share", 0 < self.inlier_share < 1, "above 0 and below 1")
        check_positive(self, "odometry_scale")
        check_not_negative(self, "witness_m", "least_apart_m")


_STARTS = 32  # sets that are grown, from the loops which agree with most others


@dataclass(frozen=True, eq=False)
class MeasuredLoops:
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


def odometry_chi2(loops: MeasuredLoops, chain: OdometryChain, scale: float) -> Array:
    """``(M,)`` squared distances, in standard deviations, of loops from where odometry has their ends."""
    predicted = chain.relative(loops.earlier, loops.later)
    covariance = scale * chain.covariance(loops.earlier, loops.later) + loops.covariances
    return _chi2(se3.log(se3.between(predicted, loops.poses)), covariance)


def pairwise_chi2(loops: MeasuredLoops, chain: OdometryChain, scale: float) -> Array:
    """``(M, M)`` squared distances, in standard deviations, by which the cycle of each two loops misses its start."""
    out = np.zeros((len(loops.earlier), len(loops.earlier)))
    for a in range(len(out) - 1):
        rest = np.arange(a + 1, len(out))
        out[a, rest] = out[rest, a] = _cycle_chi2(loops, a, rest, chain, scale)
    return out


def _cycle_chi2(loops: MeasuredLoops, a: int, b: Index, chain: OdometryChain, scale: float) -> Array:
    """Along loop ``a``, by odometry to the later end of each ``b``, back along it, and by odometry to the start."""
    start, end = np.full(len(b), loops.earlier[a]), np.full(len(b), loops.later[a])
    on, back = chain.relative(end, loops.later[b]), chain.relative(loops.earlier[b], start)
    homeward = se3.inverse(loops.poses[b]) @ back
    error = se3.log(loops.poses[a] @ on @ homeward)
    covariance = (
        se3.rotate_covariance(loops.covariances[a], se3.inverse(on @ homeward))
        + se3.rotate_covariance(scale * chain.covariance(end, loops.later[b]), se3.inverse(homeward))
        + se3.rotate_covariance(loops.covariances[b], se3.inverse(homeward))
        + scale * chain.covariance(loops.earlier[b], start)
    )
    return _chi2(error, covariance)


def _chi2(errors: Array, covariances: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))


def witnessed(loops: MeasuredLoops, agree: Mask, travelled_m: Array, settings: ConsistencySettings) -> Mask:
    """``(M,)``: which loops have another one nearby that agrees with them."""
    gaps = [np.abs(np.subtract.outer(travelled_m[rows], travelled_m[rows])) for rows in (loops.earlier, loops.later)]
    farther = np.maximum(*gaps)
    near = (farther <= settings.witness_m) & (farther >= settings.least_apart_m)
    return np.asarray((near & agree).any(axis=1))


def largest_agreeing(agree: Mask) -> Mask:
    """``(M,)``: loops which all agree with one another: the largest of the sets grown from the likeliest ones."""
    agree = agree & ~np.eye(len(agree), dtype=bool)
    best = np.zeros(len(agree), bool)
    for start in np.argsort(-agree.sum(axis=1), kind="stable")[:_STARTS]:
        grown = _grow(agree, int(start))
        best = grown if grown.sum() > best.sum() else best
    return best


def _grow(agree: Mask, start: int) -> Mask:
    """Add, while there is any, the loop that agrees with all so far and with most of the others that do."""
    taken = np.zeros(len(agree), bool)
    taken[start] = True
    left = agree[start].copy()
    while left.any():
        degrees = np.where(left, agree[:, left].sum(axis=1), -1)
        chosen = int(degrees.argmax())
        taken[chosen] = True
        left &= agree[chosen]
    return taken
