"""Which share of a scan's points usually finds the map, learned from the scans of a run."""

from __future__ import annotations

from collections.abc import Mapping

_MEMORY_SCANS = 20  # as the memory of motions: 2 s at 10 Hz, in which a scene changes
# Of the usual share. It varies by a tenth from scan to scan (simulated towns, roads and rooms); half of it is left
# where the scans jump to a place a few metres away.
_POOR_SHARE = 0.75


class UsualFit:
    """Judges whether a scan finds the map as the scans before it did."""

    def __init__(self) -> None:
        self._share = 0.0

    def is_poor(self, details: Mapping[str, float]) -> bool:
        """Return whether clearly fewer points than usual find the map; False where nothing is known of it."""
        return details.get("matched", self._share) < _POOR_SHARE * self._share

    def learn(self, details: Mapping[str, float]) -> None:
        """Take the scan as one that is where it was found."""
        if "matched" in details:
            memory = _MEMORY_SCANS if self._share else 1
            self._share += (details["matched"] - self._share) / memory
