"""The loop of motion compensation over the points of a sweep, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array, Floats

_SERIES_RAD = 0.25  # below it five terms are exact to 1e-15; an interval of a sweep turns by less
_NS_PER_S = 1e9


@compiled
def move_points(points: Floats, offsets_ns: NDArray[np.int64], knots_s: Array, rates: Array, screws: Array) -> Floats:
    """Return the points ``(N, 3)``, each moved by the screw of its time's interval.

    Args:
        points: ``(N, 3)`` float32, each in the frame of its own time.
        offsets_ns: ``(N,)`` times of the points.
        knots_s: ``(K,)`` ascending times of the poses; the first and the last interval also hold for times beyond.
        rates: ``(K - 1,)`` angular rates, rad/s.
        screws: ``(K - 1, 3, 13)`` as :func:`hybridlio.cloud.deskew.screws` returns them.
    """
    moved = np.empty_like(points)
    last, k = len(rates) - 1, 0
    for i in range(len(points)):
        time_s = offsets_ns[i] / _NS_PER_S
        while k < last and time_s >= knots_s[k + 1]:
            k += 1
        while k > 0 and time_s < knots_s[k]:
            k -= 1
        seconds = time_s - knots_s[k]
        sine, versine = _sine_and_versine(rates[k] * seconds)
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for row in range(3):
            s = screws[k, row]
            still = s[0] * x + s[1] * y + s[2] * z + s[3]
            turned = s[4] * x + s[5] * y + s[6] * z + s[7]
            bent = s[8] * x + s[9] * y + s[10] * z + s[11]
            moved[i, row] = still + seconds * s[12] + sine * turned + versine * bent
    return moved


@compiled
def _sine_and_versine(angle: float) -> tuple[float, float]:
    """Return the sine, and one less the cosine."""
    if abs(angle) > _SERIES_RAD:
        return math.sin(angle), 2 * math.sin(angle / 2) ** 2
    q = angle * angle
    sine = angle * (1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72))))
    return sine, q / 2 * (1 - q / 12 * (1 - q / 30 * (1 - q / 56 * (1 - q / 90))))
