"""The loops of voxel averages over points, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array, Floats

Keys = NDArray[np.int64]

_MULTIPLIER = 0x9E3779B97F4A7C15 - (1 << 64)  # of Fibonacci hashing: 2^64 over the golden ratio, as a signed number
_EMPTY = -1  # keys and labels are not negative
_FIRST_TABLE = 4096  # slots, of 16 KB, which stay in the fastest cache; it grows with the number of cells


@compiled
def extent(points: Floats, side_m: np.float32) -> tuple[Floats, Floats]:
    """Return the lowest and the highest cell ``(3,)`` of the points ``(N, 3)``, at least one, as float32."""
    low, high = np.empty(3, np.float32), np.empty(3, np.float32)
    for j in range(3):
        least = most = points[0, j]
        for i in range(1, len(points)):
            value = points[i, j]
            least, most = min(least, value), max(most, value)
        low[j], high[j] = np.floor(least / side_m), np.floor(most / side_m)
    return low, high


@compiled
def label(points: Floats, side_m: np.float32, low: Floats, ny: int, nx: int) -> tuple[Keys, Keys]:
    """Label points ``(N, 3)`` by their cell in the order in which cells occur.

    Args:
        points: finite.
        side_m: of the cells.
        low: ``(3,)`` the lowest cell of all points.
        ny, nx: number of cells along y and x.

    Returns:
        the labels ``(N,)``, and the keys ``(M,)`` of the cells: ``(z·ny + y)·nx + x`` from the lowest.
    """
    labels, keys, count = np.empty(len(points), np.int64), np.empty(len(points), np.int64), 0
    table, before, same = np.full(_FIRST_TABLE, _EMPTY, np.int32), np.int64(_EMPTY), np.int32(0)
    for i in range(len(points)):
        x = np.int64(np.floor(points[i, 0] / side_m) - low[0])
        y = np.int64(np.floor(points[i, 1] / side_m) - low[1])
        z = np.int64(np.floor(points[i, 2] / side_m) - low[2])
        key = (z * ny + y) * nx + x
        if key != before:  # consecutive points are often in one cell
            slot = _slot(table, keys, key)
            if table[slot] == _EMPTY:
                table[slot], keys[count] = count, key
                count += 1
            before, same = key, table[slot]
            if 2 * count > len(table):
                table = _table_of(keys[:count], 4 * len(table))
        labels[i] = same
    return labels, keys[:count].copy()


@compiled
def _slot(table: NDArray[np.int32], keys: Keys, key: np.int64) -> np.int64:
    """Return where a hash table holds the label of a key, or would hold it."""
    slot = ((key * _MULTIPLIER) >> 32) & (len(table) - 1)
    while table[slot] != _EMPTY and keys[table[slot]] != key:
        slot = (slot + 1) & (len(table) - 1)
    return slot


@compiled
def _table_of(keys: Keys, size: int) -> NDArray[np.int32]:
    """Return a hash table of labels in the order of the keys."""
    table = np.full(size, _EMPTY, np.int32)
    for k in range(len(keys)):
        table[_slot(table, keys, keys[k])] = k
    return table


@compiled
def sums(values: Floats, labels: Keys, count: int) -> tuple[Array, Keys]:
    """Return for each label the sum ``(count, C)`` of its values ``(N, C)``, and the number ``(count,)`` of them."""
    total, members = np.zeros((count, values.shape[1])), np.zeros(count, np.int64)
    for i in range(len(values)):
        k = labels[i]
        members[k] += 1
        for j in range(values.shape[1]):
            total[k, j] += values[i, j]
    return total, members


@compiled
def nearest_to(centres: Floats, points: Floats, labels: Keys) -> Keys:
    """Return for each of the centres ``(M, 3)`` the first of its nearest points ``(N, 3)`` of that label."""
    picked, least = np.zeros(len(centres), np.int64), np.full(len(centres), np.inf, np.float32)
    for i in range(len(points)):
        k = labels[i]
        dx, dy, dz = points[i, 0] - centres[k, 0], points[i, 1] - centres[k, 1], points[i, 2] - centres[k, 2]
        distance2 = dx * dx + dy * dy + dz * dz
        if distance2 < least[k]:
            least[k], picked[k] = distance2, i
    return picked


@compiled
def flagged(points: Array, low: Array, side_m: float, most: Array, table: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether each of the points ``(N, 3)`` is in a flagged block.

    Args:
        points: any; those outside the table's box count as in its outermost blocks.
        low: ``(3,)`` corner of the box.
        side_m: of the blocks.
        most: ``(3,)`` largest block along each axis.
        table: flags of all blocks, x slowest.
    """
    out = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        block = np.int64(0)
        for j in range(3):
            cell = np.int64(min(max((points[i, j] - low[j]) / side_m, 0.0), most[j]))
            block = block * (np.int64(most[j]) + 1) + cell
        out[i] = table[block]
    return out


@compiled
def merge(rows: Keys, index: Keys, distance2: Array, more: Keys, more2: Array) -> None:
    """Merge nearest points of some of the rows with others, in place; both in ascending order.

    Args:
        rows: ``(R,)`` numbers of the rows.
        index, distance2: ``(N, K)`` points and their squared distances.
        more, more2: ``(R, K)`` the others.
    """
    count = index.shape[1]
    kept, kept2 = np.empty(count, np.int64), np.empty(count)
    for r in range(len(rows)):
        row, a, b = rows[r], 0, 0
        for k in range(count):
            if more2[r, b] < distance2[row, a]:
                kept[k], kept2[k], b = more[r, b], more2[r, b], b + 1
            else:
                kept[k], kept2[k], a = index[row, a], distance2[row, a], a + 1
        for k in range(count):
            index[row, k], distance2[row, k] = kept[k], kept2[k]
