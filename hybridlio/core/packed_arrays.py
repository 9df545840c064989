"""Arrays in less memory, for what is kept of a run and not looked at until its end. Nothing is lost."""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T")

_AT_ONCE = 50


@dataclass(frozen=True)
class PackedArray:
    """Any array of plain values. A covariance takes three fifths: what stands twice in it is kept once."""

    data: bytes
    dtype: str
    shape: tuple[int, ...]

    @classmethod
    def of(cls, array: NDArray[Any]) -> PackedArray:
        """The array, packed."""
        return cls(zlib.compress(array.tobytes(), 1), array.dtype.str, array.shape)

    def array(self) -> NDArray[Any]:
        """As it was."""
        return np.frombuffer(zlib.decompress(self.data), self.dtype).reshape(self.shape)


def packed(arrays: Mapping[str, NDArray[Any]]) -> dict[str, PackedArray]:
    """Each of them packed."""
    return {name: PackedArray.of(array) for name, array in arrays.items()}


def unpacked(arrays: Mapping[str, PackedArray]) -> dict[str, NDArray[Any]]:
    """As they were."""
    return {name: array.array() for name, array in arrays.items()}


@dataclass(frozen=True)
class PackedCloud:
    """Points in whole numbers, sorted by cubic cells of about ``step``: in five ninths of their memory.

    From one point to the next, cells differ by little. Places within a cell are anyone's guess, but few.
    """

    cells: bytes
    inside: bytes
    step: int

    @classmethod
    def of(cls, cloud: NDArray[np.int16], step: int) -> PackedCloud:
        """The cloud ``(n, 3)``, packed; ``step`` is at most 256."""
        cells, inside = np.divmod(cloud.T, np.int16(step))
        ways = np.diff(cells, axis=1, prepend=np.int16(0))
        coder = zlib.compressobj(1, strategy=zlib.Z_HUFFMAN_ONLY)
        return cls(
            zlib.compress(ways.tobytes(), 1), coder.compress(inside.astype(np.uint8).tobytes()) + coder.flush(), step
        )

    def cloud(self) -> NDArray[np.int16]:
        """As it was."""
        ways = np.frombuffer(zlib.decompress(self.cells), np.int16).reshape(3, -1)
        inside = np.frombuffer(zlib.decompress(self.inside), np.uint8).reshape(3, -1)
        cells = np.cumsum(ways, axis=1, dtype=np.int16)
        return np.ascontiguousarray((cells * np.int16(self.step) + inside).T.astype(np.int16))


class PackedList(Sequence[_T]):
    """A list that is added to and seldom read: all but the newest items are packed, in a third of their memory.

    What is read comes back as new objects. Nothing of it goes to files or other processes.
    """

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._recent: list[_T] = []

    def append(self, item: _T) -> None:
        """Add one item."""
        if len(self._recent) >= 2 * _AT_ONCE:  # the newest stay at hand
            self._packed.append(zlib.compress(pickle.dumps(self._recent[:_AT_ONCE], pickle.HIGHEST_PROTOCOL), 1))
            del self._recent[:_AT_ONCE]
        self._recent.append(item)

    def __len__(self) -> int:
        return _AT_ONCE * len(self._packed) + len(self._recent)

    def __iter__(self) -> Iterator[_T]:
        for k in range(len(self._packed)):
            yield from self._part(k)
        yield from self._recent

    @overload
    def __getitem__(self, index: int) -> _T: ...
    @overload
    def __getitem__(self, index: slice) -> list[_T]: ...
    def __getitem__(self, index: int | slice) -> _T | list[_T]:
        if isinstance(index, slice):
            return list(self)[index]
        k = range(len(self))[index]
        part, place = divmod(k, _AT_ONCE)
        if part < len(self._packed):
            return self._part(part)[place]
        return self._recent[k - _AT_ONCE * len(self._packed)]

    def _part(self, k: int) -> list[_T]:
        items: list[_T] = pickle.loads(zlib.decompress(self._packed[k]))  # this process's own
        return items
