"""The loops of plane fitting over groups of neighbours, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array

_SWEEPS = 12  # four or five make all products of 3 x 3 matrices diagonal to rounding


@compiled
def principal_axes(groups: Array) -> tuple[Array, Array]:
    """Return the mean squares ``(M, 3)`` of groups of points ``(M, K, 3)`` along their axes, ascending, and the axes.

    The axes ``(M, 3, 3)`` are columns.
    """
    squares, axes = np.empty((len(groups), 3)), np.empty((len(groups), 3, 3))
    scatter = np.empty((3, 3))
    count = groups.shape[1]
    for i in range(len(groups)):
        mean = np.zeros(3)
        for k in range(count):
            mean += groups[i, k] / count
        scatter[:] = 0.0
        for k in range(count):
            for a in range(3):
                for b in range(a, 3):
                    scatter[a, b] += (groups[i, k, a] - mean[a]) * (groups[i, k, b] - mean[b])
        _diagonalise(scatter, axes[i])
        _sort(scatter, axes[i])
        for a in range(3):
            squares[i, a] = max(scatter[a, a], 0.0) / count
    return squares, axes


@compiled
def _diagonalise(matrix: Array, axes: Array) -> None:
    """Turn the upper triangle of a symmetric ``(3, 3)`` matrix to diagonal form by Jacobi's rotations."""
    axes[:] = np.eye(3)
    for _ in range(_SWEEPS):
        if matrix[0, 1] == 0.0 and matrix[0, 2] == 0.0 and matrix[1, 2] == 0.0:
            return
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            off = matrix[p, q]
            if abs(off) <= 1e-17 * (abs(matrix[p, p]) + abs(matrix[q, q])):
                matrix[p, q] = 0.0
                continue
            theta = (matrix[q, q] - matrix[p, p]) / (2 * off)
            t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
            if theta < 0:
                t = -t
            c = 1 / np.sqrt(t * t + 1)
            s = t * c
            matrix[p, p] -= t * off
            matrix[q, q] += t * off
            matrix[p, q] = 0.0
            pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
            with_p, with_q = matrix[pr[0], pr[1]], matrix[qr[0], qr[1]]
            matrix[pr[0], pr[1]], matrix[qr[0], qr[1]] = c * with_p - s * with_q, s * with_p + c * with_q
            for a in range(3):
                along_p, along_q = axes[a, p], axes[a, q]
                axes[a, p], axes[a, q] = c * along_p - s * along_q, s * along_p + c * along_q


@compiled
def _sort(matrix: Array, axes: Array) -> None:
    """Order a diagonal ``(3, 3)`` matrix and the columns of ``axes`` by ascending entries."""
    for first, second in ((0, 1), (1, 2), (0, 1)):
        if matrix[first, first] > matrix[second, second]:
            matrix[first, first], matrix[second, second] = matrix[second, second], matrix[first, first]
            for a in range(3):
                axes[a, first], axes[a, second] = axes[a, second], axes[a, first]


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
