"""An array that grows by rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Mask

_SMALLEST_CAPACITY = 16  # rows: a small graph then grows its columns once or twice


class GrowingArray:
    """An array that takes new rows at its end in amortised constant time each."""

    def __init__(self, shape: tuple[int, ...], dtype: Any = np.float64) -> None:
        self._buffer = np.empty((0, *shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> NDArray[Any]:
        """View of the rows so far; only valid until the next :meth:`extend`, which may move the memory."""
        return self._buffer[: self._count]

    def extend(self, rows: ArrayLike) -> None:
        """Add rows at the end."""
        rows = np.asarray(rows, dtype=self._buffer.dtype)
        needed = self._count + len(rows)
        if needed > len(self._buffer):
            capacity = max(needed, 2 * self._count, _SMALLEST_CAPACITY)
            buffer = np.empty((capacity, *self._buffer.shape[1:]), dtype=self._buffer.dtype)
            buffer[: self._count] = self.array
            self._buffer = buffer
        self._buffer[self._count : needed] = rows
        self._count = needed

    def where(self, keep: Mask | slice) -> GrowingArray:
        """Return a copy of some rows."""
        copy = GrowingArray(self._buffer.shape[1:], self._buffer.dtype)
        copy._buffer = np.array(self.array[keep])
        copy._count = len(copy._buffer)
        return copy
