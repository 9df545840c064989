"""Search for the motion of a scan when its speed is unknown: of many candidates, the one at which it fits best.

Two scans see the ground along different rings, so most ground points of a moving vehicle have no neighbour, or one by
chance. Candidates are therefore compared by the cost of their matched points alone, among those with about as many
matches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.icp import fit_at, register
from hybridlio.registration.results import Fit, Registration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

# Kernel of the search, in greatest distances of a match: 0.5 m of 1 m. Candidates' speeds are 2.5 m/s apart: 0.25 m at
# 10 Hz and 0.5 m at 5 Hz, so it reaches from one to the next.
_COARSE_KERNEL = 0.5
_JUDGED_STRIDE = 8  # every eighth point, some hundreds, are enough to compare candidates one kernel width apart
_COARSE_ITERATIONS = 6  # three while the kernel is halved from 0.5 to 0.1 m, and three under the narrow one
_REFINED_CANDIDATES = 12  # of 18 speeds and 5 rates of turn by default: the best one and those beside it in both
# Between rotations that are tried, and the farthest: half a step displaces points 7 m away by a coarse kernel.
_LARGEST_RATE_RAD_S = 2.6  # of hands and heads: 150 °/s, over half a second
_LEAST_TURN_STEPS = 2
_TURN_STEP_RAD, _LARGEST_TURN_RAD = np.radians(8.0), np.radians(80.0)
_MIN_MATCHED_RATIO = 0.8  # to the most matches of any candidate; with few matches a low cost is easy to have


@dataclass(frozen=True)
class CoarseSearch:
    """How many starts are refined, and how.

    Attributes:
        kernel_m: kernel that compares the starts, and that the refinement begins with.
        iterations: Gauss-Newton steps of the refinement.
        refined: number of starts that are refined, the best ones.
    """

    kernel_m: float
    iterations: int
    refined: int


def coarse_kernel_m(settings: RegistrationSettings) -> float:
    """Return the width of the kernel for starts that lie between two candidates of a search."""
    return _COARSE_KERNEL * settings.max_distance_m


def motions(speeds_m_s: Iterable[float], rates_deg_s: Iterable[float], dt_s: float) -> list[Array]:
    """Return poses ``(4, 4)`` after ``dt_s`` seconds, for every forward speed with every rate of turn."""
    pairs = product(speeds_m_s, np.deg2rad(list(rates_deg_s)))
    return [se3.exp(np.array([0, 0, rate, speed, 0, 0]) * dt_s) for speed, rate in pairs]


def starts_after(
    last: Array, step: Array, speeds_m_s: Sequence[float], rates_deg_s: Sequence[float], dt_s: float, turns: bool
) -> list[Array]:
    """Return poses ``(4, 4)`` at which a scan may be whose motion is unknown.

    Args:
        last: ``(4, 4)`` pose of the last scan.
        step: ``(4, 4)`` initial relative pose of this one, to which motions are added.
        speeds_m_s: forward speeds to try.
        rates_deg_s: yaw rates to try with each, if it may turn; turns about the other axes are tried then as well.
        dt_s: time since the last scan.
        turns: whether the turn of the step is unknown, too.
    """
    starts = [last @ step @ motion for motion in motions(speeds_m_s, rates_deg_s if turns else (0.0,), dt_s)]
    return starts + (rotated(last, last @ step, dt_s) if turns else [])


def rotated(T_map_before: Array, T_map_start: Array, dt_s: float) -> list[Array]:
    """Return poses ``(4, 4)`` at the place of a start, rotated against the scan before as bodies turn in ``dt_s``.

    Bodies turn about the vertical most, and few lidars are mounted on their side: the largest angle is the one about z,
    and half of it about x and y. Within a tenth of a second the rates of :func:`motions` and the kernel reach as far,
    and there are none.
    """
    reach = np.array([0.5, 0.5, 1.0]) * min(_LARGEST_RATE_RAD_S * dt_s, _LARGEST_TURN_RAD)
    if reach[2] < _LEAST_TURN_STEPS * _TURN_STEP_RAD:
        return []
    grid = product(*(_TURN_STEP_RAD * np.arange(-n, n + 1) for n in np.floor(reach / _TURN_STEP_RAD).astype(int)))
    turns = [np.array(turn) for turn in grid if ((np.array(turn) / reach) ** 2).sum() <= 1.0]
    beside = se3.make(T_map_before[:3, :3], T_map_start[:3, 3])
    return [beside @ se3.exp(np.r_[turn, np.zeros(3)]) for turn in sorted(turns, key=np.linalg.norm)]


def by_cost(fits: Sequence[Fit]) -> list[int]:
    """Return indices of the fits, the lowest cost first."""
    return sorted(range(len(fits)), key=lambda i: fits[i].cost)


def refine_best(
    surface: Surface,
    few: Array,
    source: Array,
    starts: Sequence[Array],
    settings: RegistrationSettings,
    search: CoarseSearch,
    ranked: Callable[[Sequence[Fit]], list[int]] = by_cost,
) -> list[Registration]:
    """Compare starts by a few points, and register from the best of them.

    Args:
        surface: what the scan is registered to.
        few: ``(K, 3)`` points for the comparison, scan frame.
        source: ``(M, 3)`` points for the registration, scan frame.
        starts: ``(4, 4)`` poses in the surface's frame.
        settings: of the registration.
        search: kernel and limits.
        ranked: returns indices of the fits to consider, the best first.
    """
    fits = [fit_at(surface, few, T, search.kernel_m, settings.threads) for T in starts]
    coarse = replace(settings, max_iterations=search.iterations)
    return [register(surface, source, starts[i], coarse, search.kernel_m) for i in ranked(fits)[: search.refined]]


def best_start(
    surface: Surface, source: Array, points: Array, starts: Sequence[Array], settings: RegistrationSettings
) -> Array:
    """Return the best start, after some Gauss-Newton steps.

    All starts are compared by a few points; the best of them are refined and compared by all points.

    Args:
        surface: what the scan is registered to.
        source: ``(M, 3)`` the scan's points for registration, scan frame.
        points: ``(N, 3)`` more of them, for the last comparison.
        starts: ``(4, 4)`` poses in the surface's frame.
        settings: of the registration.
    """
    search = CoarseSearch(coarse_kernel_m(settings), _COARSE_ITERATIONS, _REFINED_CANDIDATES)
    few = source[::_JUDGED_STRIDE]
    refined = [found.pose for found in refine_best(surface, few, source, starts, settings, search, _ranked)]
    max_distance_m = settings.max_distance_m
    fits = [fit_at(surface, points, T, settings.kernel_m, settings.threads, max_distance_m) for T in refined]
    return refined[_ranked(fits)[0]]


def fits_better(surface: Surface, source: Array, one: Array, other: Array, kernel_m: float, threads: int) -> bool:
    """Return whether ``source`` ``(M, 3)`` has a lower cost at the first pose ``(4, 4)`` than at the other."""
    here, there = (fit_at(surface, source[::_JUDGED_STRIDE], T, kernel_m, threads).cost for T in (one, other))
    return here < there


def _ranked(fits: Sequence[Fit]) -> list[int]:
    """Return indices of the fits with enough matches, the lowest cost of matched points first."""
    most = max(fit.matched for fit in fits)
    enough = (i for i, fit in enumerate(fits) if fit.matched >= _MIN_MATCHED_RATIO * most)
    return sorted(enough, key=lambda i: fits[i].matched_cost)
