"""Which way to start where nobody knows how fast the vehicle goes: the motion under which a scan lies best.

Where two scans see ground along other rings, most of it has no neighbour or has one by chance. What counts is how well
those points lie that have.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.icp import Fit, RegistrationSettings, fit_at, register
from hybridlio.registration.surface import Surface

COARSE_KERNEL_M = 0.5
_SPARSE = 8  # one in so many points is enough to tell a metre from another
_COARSE_ITERATIONS = 6
_LIKELY = 12
_OVERLAP = 0.8  # of the most points that match: to lie on fewer is easier


def motions(speeds_m_s: Iterable[float], rates_deg_s: Iterable[float], dt_s: float) -> list[Array]:
    """``(4, 4)`` each, of every speed ahead with every rate of turn, kept for ``dt_s``."""
    pairs = product(speeds_m_s, np.deg2rad(list(rates_deg_s)))
    return [se3.exp(np.array([0, 0, rate, speed, 0, 0]) * dt_s) for speed, rate in pairs]


def best_start(
    surface: Surface, source: Array, points: Array, starts: Sequence[Array], settings: RegistrationSettings
) -> Array:
    """The best of ``starts`` after some steps: all are judged by few points, the likelier ones by all of them.

    Args:
        surface: what the scan is registered to.
        source: ``(M, 3)`` the scan's points for registration.
        points: ``(N, 3)`` more of them, to judge by.
        starts: ``(4, 4)`` poses in the surface's frame.
        settings: of the registration.
    """
    fits = [fit_at(surface, source[::_SPARSE], T, COARSE_KERNEL_M, settings.threads) for T in starts]
    coarse, likely = replace(settings, max_iterations=_COARSE_ITERATIONS), _best(fits)[:_LIKELY]
    tries = [register(surface, source, starts[i], coarse, COARSE_KERNEL_M).pose for i in likely]
    reach_m = settings.max_distance_m
    fits = [fit_at(surface, points, T, settings.kernel_m, settings.threads, reach_m) for T in tries]
    return tries[_best(fits)[0]]


def lies_better(surface: Surface, source: Array, one: Array, other: Array, kernel_m: float, threads: int) -> bool:
    """Whether ``source`` ``(M, 3)`` lies better on the surface at one pose ``(4, 4)`` than at the other."""
    here, there = (fit_at(surface, source[::_SPARSE], T, kernel_m, threads).cost for T in (one, other))
    return here < there


def _best(fits: Sequence[Fit]) -> list[int]:
    """Their numbers, the best first; those of much fewer points are left out."""
    most = max(fit.matched for fit in fits)
    return sorted((i for i, fit in enumerate(fits) if fit.matched >= _OVERLAP * most), key=lambda i: fits[i].misfit)
