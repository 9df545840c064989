"""Which scans a graph holds: their numbers by stamp, and which of them have a pose on the map path."""

from __future__ import annotations

from collections.abc import Iterable

from hybridlio.core.errors import DataError


class ScanNumbers:
    """Numbers of the scans in a graph, from 0; the oldest scans may be removed.

    Args:
        stamp_ns: of scan 0.
    """

    def __init__(self, stamp_ns: int) -> None:
        self._numbers = {stamp_ns: 0}
        self._stamps = {0: stamp_ns}
        self._newest = 0
        self._on_map_path: set[int] = set()

    def add(self, stamp_ns: int, on_map_path: bool) -> None:
        """Add the next scan; ``on_map_path``: it and the scan before have poses on the map path."""
        self._newest += 1
        self._numbers[stamp_ns] = self._newest
        self._stamps[self._newest] = stamp_ns
        if on_map_path:
            self._on_map_path |= {self._newest - 1, self._newest}

    def is_on_map_path(self, number: int) -> bool:
        """Whether the scan has a pose on the map path (:func:`hybridlio.graph.run.factors.map_path_factors`)."""
        return number in self._on_map_path

    def remove(self, numbers: Iterable[int]) -> None:
        """Remove scans that have left the graph."""
        for number in numbers:
            self._numbers.pop(self._stamps.pop(number), None)
            self._on_map_path.discard(number)

    def number(self, stamp_ns: int) -> int | None:
        """Return the scan's number, or None if it is older than all scans in the graph.

        Raises:
            DataError: no scan has this stamp.
        """
        found = self._numbers.get(stamp_ns)
        if found is None and stamp_ns >= min(self._numbers):
            raise DataError(
                f"a pose is relative to the scan at {stamp_ns} ns, but no scan has this stamp; "
                "give the stamp of an earlier scan"
            )
        return found
