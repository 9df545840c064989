"""The loops of a registration over its matches, compiled: least squares and Gauss-Newton steps.

Formulas are in :mod:`hybridlio.registration.surface`, :mod:`hybridlio.registration.point_to_point` and
:mod:`hybridlio.registration.information`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array

# A step below both has converged: 1 mm at 50 m and 0.3 mm, less than the standard deviation of any registration.
_ROTATION_CONVERGED_RAD = 2e-5
_TRANSLATION_CONVERGED_M = 3e-4
# A pose that has moved by either is matched again: 1 cm at 50 m and 5 mm, a few per cent of the spacing of map points.
_REMATCH_ROTATION_RAD = 2e-4
_REMATCH_TRANSLATION_M = 5e-3
_LONG_STEP = 10.0  # times the way to a rematch: 5 cm or 2 mrad. After such a step most matches are wrong: match at once
_MIN_MATCHES = 6  # as many as unknowns; with fewer the Hessian is singular and the pose stays


class Rows(NamedTuple):
    """Matches linearised at a pose: six derivatives and the distance, in this order.

    Attributes:
        planes: ``(7, N)`` of points matched with planes.
        plane_weights: ``(N,)`` of the planes.
        points: ``(7, 3, M)`` of points matched with points.
        point_weights: ``(M,)`` of their neighbours.
    """

    planes: Array
    plane_weights: Array
    points: Array
    point_weights: Array


class Free(NamedTuple):
    """The directions in which a pose may move.

    Attributes:
        directions: ``(6, K)`` tangent vectors (rad, m), orthonormal in the units of
            :func:`hybridlio.registration.information.scaled_spectrum`.
        least_share: principal directions with a smaller share of the information than this are left out.
    """

    directions: Array
    least_share: float


class Sums(NamedTuple):
    """Sums over the matches at one pose.

    Attributes:
        hessian, gradient: ``(6, 6)`` and ``(6,)`` of half the weighted squared distances.
        weight, squares: of the weights, and of the weighted squared distances.
        cost: of the robust costs under the narrow kernel.
    """

    hessian: Array
    gradient: Array
    weight: float
    squares: float
    cost: float


@compiled
def system(rows: Rows, xi: Array, kernel_m: float, narrow_m: float) -> Sums:
    """Return the least squares of one step at the rows' pose moved by ``xi`` ``(6,)``.

    Args:
        rows: the matches.
        xi: small tangent vector.
        kernel_m: of the weights.
        narrow_m: kernel of the cost.
    """
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    total_weight, total_squares, cost = 0.0, 0.0, 0.0
    one, difference = np.empty(6), np.empty(3)
    for i in range(rows.planes.shape[1]):
        distance = rows.planes[6, i]
        for j in range(6):
            one[j] = rows.planes[j, i]
            distance += xi[j] * one[j]
        squared = distance * distance
        weight = rows.plane_weights[i] * (kernel_m**2 / (kernel_m**2 + squared)) ** 2
        _add(hessian, gradient, one, weight, distance)
        total_weight += weight
        total_squares += weight * squared
        cost += squared / (narrow_m**2 + squared)
    for i in range(rows.points.shape[2]):
        squared = 0.0
        for row in range(3):
            difference[row] = rows.points[6, row, i]
            for j in range(6):
                difference[row] += xi[j] * rows.points[j, row, i]
            squared += difference[row] ** 2
        own = rows.point_weights[i]
        weight = own * (kernel_m**2 / (kernel_m**2 + own * squared)) ** 2
        for row in range(3):
            for j in range(6):
                one[j] = rows.points[j, row, i]
            _add(hessian, gradient, one, weight, difference[row])
        total_weight += weight
        total_squares += weight * squared
        cost += squared / (narrow_m**2 + squared)
    for j in range(6):
        for k in range(j):
            hessian[j, k] = hessian[k, j]
    return Sums(hessian, gradient, total_weight, total_squares, cost)


@compiled
def _add(hessian: Array, gradient: Array, row: Array, weight: float, distance: float) -> None:
    """Add one residual to the upper triangle of the Hessian, and to the gradient."""
    for j in range(6):
        weighted = weight * row[j]
        gradient[j] += weighted * distance
        for k in range(j, 6):
            hessian[j, k] += weighted * row[k]


@compiled
def newton_step(hessian: Array, gradient: Array, free: Free) -> Array:
    """Return the step ``(6,)`` within the strong ones of the free directions."""
    count = free.directions.shape[1]
    reduced, slope = np.zeros((count, count)), np.zeros(count)
    for a in range(count):
        for i in range(6):
            slope[a] += free.directions[i, a] * gradient[i]
            for b in range(count):
                for j in range(6):
                    reduced[a, b] += free.directions[i, a] * hessian[i, j] * free.directions[j, b]
    values, vectors = np.linalg.eigh(reduced)
    least = free.least_share * (hessian[3, 3] + hessian[4, 4] + hessian[5, 5])
    step = np.zeros(6)
    for k in range(count):
        if values[k] < least:
            continue
        along = 0.0
        for a in range(count):
            along += vectors[a, k] * slope[a]
        for a in range(count):
            for i in range(6):
                step[i] -= free.directions[i, a] * vectors[a, k] * along / max(values[k], 1e-12)
    return step


class Limits(NamedTuple):
    """When a descent ends: the narrow kernel, and the largest number of steps in all."""

    kernel_m: float
    max_iterations: int


class Followed(NamedTuple):
    """Where a descent along one set of matches has led.

    Attributes:
        way: ``(6,)`` sum of its steps.
        kernel_m, steps: for the next set of matches.
        converged: whether the last step was below the convergence limits.
        rematch_ratio: size of the way over that at which matches have to be made again.
        sums: where the last step began.
    """

    way: Array
    kernel_m: float
    steps: int
    converged: bool
    rematch_ratio: float
    sums: Sums


@compiled
def follow(rows: Rows, free: Free, limits: Limits, kernel_m: float, steps: int) -> Followed:
    """Step as far as the matches are valid.

    Args:
        rows: the matches.
        free: directions of the steps.
        limits: end of the descent.
        kernel_m: to begin with; halved at every step.
        steps: number of those before.
    """
    way, converged = np.zeros(6), False
    sums = system(rows, way, kernel_m, limits.kernel_m)
    enough = rows.planes.shape[1] + rows.points.shape[2] >= _MIN_MATCHES
    while True:
        step = newton_step(sums.hessian, sums.gradient, free) if enough else np.zeros(6)
        for i in range(6):
            way[i] += step[i]
        steps += 1
        is_narrow = kernel_m == limits.kernel_m
        kernel_m = max(limits.kernel_m, kernel_m / 2)
        length, far = _rematch_ratio(step), _rematch_ratio(way)
        converged = is_narrow and _is_small(step)
        # the steps have become short, but together they have gone far enough for other neighbours
        has_settled_far_off = is_narrow and length < 1 < far
        if converged or length > _LONG_STEP or has_settled_far_off or steps >= limits.max_iterations:
            return Followed(way, kernel_m, steps, converged, far, sums)
        sums = system(rows, way, kernel_m, limits.kernel_m)


@compiled
def _largest(xi: Array) -> tuple[float, float]:
    """Return the largest component of the rotation and of the translation."""
    turn, shift = 0.0, 0.0
    for i in range(3):
        turn, shift = max(turn, abs(xi[i])), max(shift, abs(xi[i + 3]))
    return turn, shift


@compiled
def _rematch_ratio(xi: Array) -> float:
    """Return the size of a tangent vector over that at which matches have to be made again."""
    turn, shift = _largest(xi)
    return max(turn / _REMATCH_ROTATION_RAD, shift / _REMATCH_TRANSLATION_M)


@compiled
def _is_small(step: Array) -> bool:
    turn, shift = _largest(step)
    return turn < _ROTATION_CONVERGED_RAD and shift < _TRANSLATION_CONVERGED_M
