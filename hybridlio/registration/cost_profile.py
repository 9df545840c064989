"""What the robust costs of a scan's points, evaluated beside a pose, say about the pose along one direction.

Let ``cᵢ(t)`` be the robust cost of point ``i`` when the pose is displaced by ``t`` metres along a direction and the
other directions have been minimised again, and ``Δᵢ(t) = cᵢ(t) − cᵢ(0)`` its rise. If the points do not observe the
direction, rises are as often negative as positive: their sum has mean 0 and, for independent points, variance
``Σ Δᵢ²``. Its square root is called the *scatter* below.

**Near the pose**, :func:`parabola_minimum` fits ``C(t) = a·t² + b·t`` through the sums at ``−h``, 0 and ``h``:

    ``2a·h² = Σ Δᵢ(h) + Σ Δᵢ(−h)`` (the rise),  ``2b·h = Σ Δᵢ(h) − Σ Δᵢ(−h)``,  minimum at ``−b / (2a)``.

The direction is observed if the rise exceeds the scatter clearly. ``b`` has the standard deviation ``scatter / (2h)``,
so the minimum has ``h·scatter / (2·rise)``.

**Farther off**, :func:`weigh_offsets` treats ``exp(−Σ Δᵢ / (1.5·scatter))`` as the likelihood of each offset on a grid
and takes its mean and variance. The grid ends at ±2 m, which acts like a prior of variance ``σ₀²``; dividing it out
again, as in a product of two normal distributions, gives what the costs alone say: ``1/σ² = 1/σ_grid² − 1/σ₀²`` and
``mean = σ²·mean_grid/σ_grid²``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.registration.information import UNKNOWN_SIGMA_M

# Displacement h of the parabola at the default kernel: larger than the spacing of map points, so that points find other
# neighbours there.
PROBE_STEP_M = 0.5
# Rise over scatter of an observed direction. On simulated drives smooth walls stayed at or below 3.5, and an open field
# with bushes was at 6 or more.
_OBSERVED_RATIO = 4.5
# As far as a first step may be wrong without any source of speed (20 m/s at 10 Hz), PROBE_STEP_M apart.
OFFSETS_M = np.linspace(-2.0, 2.0, 9)
# Temperature of exp(−rise / (1.5·scatter)), chosen so that σ is consistent with the errors between smooth walls
# (benchmarks/scenarios.py, corridor).
_TEMPERATURE = 1.5
# On the variance: successive scans see the same scene, so their errors are correlated, and the graph adds them up as
# independent. Chosen like the temperature.
_SHARED_ERROR_SCALE = 2.0
# Share of the prior's variance above which the costs are treated as uninformative; σ would exceed three times the
# prior's.
_UNINFORMATIVE_SHARE = 0.9


def parabola_minimum(rises_back: Array, rises_ahead: Array, step_m: float = PROBE_STEP_M) -> tuple[float, float]:
    """Return the offset of the cost's minimum, metres, and its standard deviation.

    Args:
        rises_back, rises_ahead: ``(N,)``, ``(M,)`` rises of the points' costs ``step_m`` to either side.
        step_m: the displacement h.

    Returns:
        both, the offset at most ``step_m`` either way. For an unobserved direction the standard deviation is
        infinite, and the offset is 0, or a whole step towards a side on which costs fall clearly.
    """
    rise = float(rises_back.sum() + rises_ahead.sum())
    scatter = float(np.sqrt(rises_back @ rises_back + rises_ahead @ rises_ahead))
    if rise <= _OBSERVED_RATIO * scatter:
        return step_m * (_falls(rises_ahead) - _falls(rises_back)), np.inf
    offset_m = step_m * float(rises_back.sum() - rises_ahead.sum()) / (2 * rise)
    return float(np.clip(offset_m, -step_m, step_m)), step_m * scatter / (2 * rise)


def _falls(rises: Array) -> bool:
    return bool(rises.sum() < -_OBSERVED_RATIO * np.sqrt(rises @ rises))


def weigh_offsets(rises: list[Array], trusted: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the likely offset along a direction, metres, and its standard deviation.

    Args:
        rises: for each of :data:`OFFSETS_M`, the rises ``(N,)`` of the points' costs there.
        trusted: ``(9,)`` whether the cost at an offset may be low; elsewhere a cost below that interpolated between
            trusted offsets is replaced by it.

    Returns:
        0 and :data:`UNKNOWN_SIGMA_M <hybridlio.registration.information.UNKNOWN_SIGMA_M>` where the costs say nothing.
    """
    if not trusted.any():
        return 0.0, UNKNOWN_SIGMA_M
    height = np.array([r.sum() / np.sqrt(r @ r + 1e-12) for r in rises]) / _TEMPERATURE
    interpolated = np.interp(OFFSETS_M, OFFSETS_M[trusted], height[trusted])
    height = np.where(trusted, height, np.maximum(height, interpolated))
    weights = np.exp(height.min() - height)
    weights /= weights.sum()
    mean = float(weights @ OFFSETS_M)
    spacing_m = OFFSETS_M[1] - OFFSETS_M[0]
    # each grid point stands for an interval, whose uniform distribution adds its variance
    variance = float(weights @ (OFFSETS_M - mean) ** 2) + spacing_m**2 / 12
    prior = float((OFFSETS_M**2).mean())
    if variance > _UNINFORMATIVE_SHARE * prior:
        return 0.0, UNKNOWN_SIGMA_M
    of_costs = 1 / (1 / variance - 1 / prior)
    return mean / variance * of_costs, float(np.sqrt(_SHARED_ERROR_SCALE * of_costs))
