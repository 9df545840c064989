"""Which scans a graph holds: their numbers by stamp, and which have a pose on the residual source's own path."""

from __future__ import annotations

from collections.abc import Iterable

from hybridlio.core.errors import DataError


class Scans:
    """Scans by number, from 0; the oldest may be forgotten.

    Args:
        stamp_ns: of scan 0.
    """

    def __init__(self, stamp_ns: int) -> None:
        self._numbers = {stamp_ns: 0}
        self._stamps = {0: stamp_ns}
        self._newest = 0
        self._on_path: set[int] = set()

    def add(self, stamp_ns: int, on_path: bool) -> None:
        """Take in the next scan; ``on_path``: it and the one before have poses on the path."""
        self._newest += 1
        self._numbers[stamp_ns] = self._newest
        self._stamps[self._newest] = stamp_ns
        if on_path:
            self._on_path |= {self._newest - 1, self._newest}

    def is_on_path(self, number: int) -> bool:
        """Whether the scan has a pose on the path."""
        return number in self._on_path

    def forget(self, numbers: Iterable[int]) -> None:
        """Let go of the scans that have left the graph."""
        for number in numbers:
            self._numbers.pop(self._stamps.pop(number), None)
            self._on_path.discard(number)

    def number(self, stamp_ns: int) -> int | None:
        """The scan's number; None for one that is older than all that are left.

        Raises:
            DataError: there is no such scan.
        """
        found = self._numbers.get(stamp_ns)
        if found is None and stamp_ns >= min(self._numbers):
            raise DataError(f"a pose relative to the scan at {stamp_ns} ns, but there is no such scan; give its stamp")
        return found
