"""What is known of a map's cells: how many points each holds, and when a scan last hit it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.voxel import voxel_labels
from hybridlio.core.arrays import Array, Index

Keys = NDArray[np.int64]

_BITS = 21  # of a cell's place along an axis
_MIDDLE = 1 << (_BITS - 1)


def cells_of(points: Array, side_m: float) -> tuple[Index, Keys]:
    """Which cell each of the points ``(N, 3)`` is in: numbers ``(N,)`` from 0, and the keys ``(C,)`` of those cells.

    Keys ascend, and a cell has the same one whatever the points.
    """
    single = points.astype(np.float32)
    labels, count = voxel_labels(single, side_m)
    one = np.empty(count, np.intp)
    one[labels] = np.arange(len(labels))  # some point of each cell
    x, y, z = np.floor(single[one] / np.float32(side_m)).astype(np.int64).T + _MIDDLE
    return labels, ((z << _BITS | y) << _BITS) | x


class CellTable:
    """Starts empty. A cell is in it as long as it may hold points."""

    def __init__(self) -> None:
        self._keys: Keys = np.empty(0, np.int64)  # ascending
        self._held = np.empty(0, np.int64)
        self._hit = np.empty(0, np.int64)

    def held(self, keys: Keys) -> NDArray[np.int64]:
        """How many points ``(C,)`` each of the cells holds."""
        at, known = self._find(keys)
        held = np.zeros(len(keys), np.int64)
        held[known] = self._held[at[known]]
        return held

    def hit(self, keys: Keys, added: NDArray[np.int64], time: int) -> None:
        """Note that a scan hit these cells at a time, and how many points ``(C,)`` they took in."""
        at, known = self._find(keys)
        self._held[at[known]] += added[known]
        self._hit[at[known]] = time
        new = ~known & (added > 0)
        self._keys = np.insert(self._keys, at[new], keys[new])
        self._held = np.insert(self._held, at[new], added[new])
        self._hit = np.insert(self._hit, at[new], time)

    def forget(self, before: int) -> None:
        """Drop the cells that were last hit before a time."""
        kept = self._hit >= before
        self._keys, self._held, self._hit = self._keys[kept], self._held[kept], self._hit[kept]

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Which of the cells ``(C,)`` are in the table."""
        return self._find(keys)[1]

    def _find(self, keys: Keys) -> tuple[Index, NDArray[np.bool_]]:
        """Where each key is or would be, and whether it is there."""
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), bool)
        inside = at < len(self._keys)
        known[inside] = self._keys[at[inside]] == keys[inside]
        return at, known
