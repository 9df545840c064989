"""Arrays in less memory, for what is kept of a run and not looked at until its end. Nothing is lost."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
