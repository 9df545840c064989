"""Lossless compression in memory, for data of a run that is not needed before its end."""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T")

_TOGETHER = 50  # items compressed at once; more compress hardly better, and reading one unpacks all


@dataclass(frozen=True)
class PackedArray:
    """A compressed array of numbers. A covariance takes three fifths of its memory, because it is symmetric."""

    data: bytes
    dtype: str
    shape: tuple[int, ...]

    @classmethod
    def of(cls, array: NDArray[Any]) -> PackedArray:
        """Compress an array."""
        return cls(zlib.compress(array.tobytes(), 1), array.dtype.str, array.shape)

    def array(self) -> NDArray[Any]:
        """Return the array, bit for bit."""
        return np.frombuffer(zlib.decompress(self.data), self.dtype).reshape(self.shape)


def pack_arrays(arrays: Mapping[str, NDArray[Any]]) -> dict[str, PackedArray]:
    """Compress each array."""
    return {name: PackedArray.of(array) for name, array in arrays.items()}


def unpack_arrays(arrays: Mapping[str, PackedArray]) -> dict[str, NDArray[Any]]:
    """Return the arrays, bit for bit."""
    return {name: array.array() for name, array in arrays.items()}


@dataclass(frozen=True)
class PackedCloud:
    """Points with integer coordinates, sorted by cubic cells of side ``step``, in five ninths of their memory.

    Cells of consecutive points are close, so their differences compress well. The positions within a cell are random,
    but take one byte a coordinate.
    """

    cells: bytes
    inside: bytes
    step: int

    @classmethod
    def of(cls, cloud: NDArray[np.int16], step: int) -> PackedCloud:
        """Compress a cloud ``(n, 3)``; ``step`` is at most 256."""
        cells, inside = np.divmod(cloud.T, np.int16(step))
        differences = np.diff(cells, axis=1, prepend=np.int16(0))
        coder = zlib.compressobj(1, strategy=zlib.Z_HUFFMAN_ONLY)
        packed_inside = coder.compress(inside.astype(np.uint8).tobytes()) + coder.flush()
        return cls(zlib.compress(differences.tobytes(), 1), packed_inside, step)

    def cloud(self) -> NDArray[np.int16]:
        """Return the cloud, bit for bit."""
        differences = np.frombuffer(zlib.decompress(self.cells), np.int16).reshape(3, -1)
        inside = np.frombuffer(zlib.decompress(self.inside), np.uint8).reshape(3, -1)
        cells = np.cumsum(differences, axis=1, dtype=np.int16)
        return np.ascontiguousarray((cells * np.int16(self.step) + inside).T.astype(np.int16))


class PackedList(Sequence[_T]):
    """A list for appending whose older items are pickled and compressed, in a third of their memory.

    Reading an older item returns a new object. The pickles stay in this process, so unpickling them is safe.
    """

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._recent: list[_T] = []

    def append(self, item: _T) -> None:
        """Append one item."""
        if len(self._recent) >= 2 * _TOGETHER:  # the newest stay as objects
            self._packed.append(zlib.compress(pickle.dumps(self._recent[:_TOGETHER], pickle.HIGHEST_PROTOCOL), 1))
            del self._recent[:_TOGETHER]
        self._recent.append(item)

    def __len__(self) -> int:
        return _TOGETHER * len(self._packed) + len(self._recent)

    def __iter__(self) -> Iterator[_T]:
        for k in range(len(self._packed)):
            yield from self._unpack(k)
        yield from self._recent

    @overload
    def __getitem__(self, index: int) -> _T: ...
    @overload
    def __getitem__(self, index: slice) -> list[_T]: ...
    def __getitem__(self, index: int | slice) -> _T | list[_T]:
        if isinstance(index, slice):
            return list(self)[index]
        k = range(len(self))[index]
        part, place = divmod(k, _TOGETHER)
        if part < len(self._packed):
            return self._unpack(part)[place]
        return self._recent[k - _TOGETHER * len(self._packed)]

    def _unpack(self, k: int) -> list[_T]:
        items: list[_T] = pickle.loads(zlib.decompress(self._packed[k]))  # made by this process
        return items
