"""The loops of plane fitting over groups of neighbours, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array

_ROUNDING = 1e-17  # of the diagonal: smaller entries beside it change nothing in double precision
_SWEEPS = 12  # four or five make all products of 3 x 3 matrices diagonal to rounding


@compiled
def principal_axes(groups: Array) -> tuple[Array, Array]:
    """Return the mean squares ``(M, 3)`` of groups of points ``(M, K, 3)`` along their axes, ascending, and the axes.

    The axes ``(M, 3, 3)`` are columns.
    """
    squares, axes = np.empty((len(groups), 3)), np.zeros((len(groups), 3, 3))
    scatter, mean = np.empty((3, 3)), np.empty(3)
    count = groups.shape[1]
    for i in range(len(groups)):
        for a in range(3):
            mean[a] = 0.0
            for k in range(count):
                mean[a] += groups[i, k, a]
            mean[a] /= count
        for a in range(3):
            for b in range(3):
                scatter[a, b] = 0.0
                for k in range(count):
                    scatter[a, b] += (groups[i, k, a] - mean[a]) * (groups[i, k, b] - mean[b])
        _diagonalise(scatter, axes[i])
        for a in range(3):
            squares[i, a] = max(scatter[a, a], 0.0) / count
        _sort(squares[i], axes[i])
    return squares, axes


@compiled
def _diagonalise(matrix: Array, axes: Array) -> None:
    """Turn a symmetric ``(3, 3)`` matrix to diagonal form by Jacobi's rotations; ``axes`` are zeros before."""
    for a in range(3):
        axes[a, a] = 1.0
    for _ in range(_SWEEPS):
        settled = True
        for p in range(2):
            for q in range(p + 1, 3):
                off, size = matrix[p, q], abs(matrix[p, p]) + abs(matrix[q, q])
                if abs(off) <= _ROUNDING * size:
                    continue
                settled = False
                theta = (matrix[q, q] - matrix[p, p]) / (2 * off)
                tangent = 1 / (abs(theta) + math.sqrt(theta * theta + 1))
                if theta < 0:
                    tangent = -tangent
                c = 1 / math.sqrt(tangent * tangent + 1)
                _rotate(matrix, p, q, c, tangent * c)
                _rotate(matrix.T, p, q, c, tangent * c)
                _rotate(axes, p, q, c, tangent * c)
        if settled:
            return


@compiled
def _rotate(matrix: Array, p: int, q: int, cosine: float, sine: float) -> None:
    """Rotate two columns of a ``(3, 3)`` matrix into each other."""
    for a in range(3):
        first, second = matrix[a, p], matrix[a, q]
        matrix[a, p], matrix[a, q] = cosine * first - sine * second, sine * first + cosine * second


@compiled
def _sort(values: Array, axes: Array) -> None:
    """Order three values and the columns of ``axes`` ``(3, 3)`` by ascending values."""
    for end in range(2, 0, -1):
        for a in range(end):
            if values[a] > values[a + 1]:
                values[a], values[a + 1] = values[a + 1], values[a]
                _rotate(axes, a, a + 1, 0.0, 1.0)


@compiled
def far_from_median(values: Array, groups: NDArray[np.uint64], distance: float) -> NDArray[np.int64]:
    """Return for each group ``(M, K)`` of indices how many of its values are farther from their median than that."""
    out, ordered = np.zeros(len(groups), np.int64), np.empty(groups.shape[1])
    count = groups.shape[1]
    for i in range(len(groups)):
        for k in range(count):  # insertion sort
            value, place = values[groups[i, k]], k
            while place > 0 and ordered[place - 1] > value:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = value
        median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
        for k in range(count):
            out[i] += abs(ordered[k] - median) > distance
    return out
