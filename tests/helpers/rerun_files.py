"""Read files of the Rerun viewer back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


class RerunFile:
    """The columns of a recording by entity and component, in order of the scan."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self._rows: dict[tuple[str, str], list[tuple[int, Any]]] = {}
        self.static: dict[tuple[str, str], Any] = {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch().to_pydict()
            scans = batch.pop("scan", None)
            for column, values in batch.items():
                key = (chunk.entity_path.removeprefix("/").replace("\\", ""), column.rpartition(":")[2])
                if scans is None:
                    self.static[key] = values[0]
                else:
                    rows = zip(scans, values, strict=True)
                    self._rows.setdefault(key, []).extend((s, v) for s, v in rows if v is not None)

    @property
    def entities(self) -> set[str]:
        """The names of all entities that change with time."""
        return {entity for entity, _ in self._rows}

    def scans(self, entity: str, component: str) -> list[int]:
        """Return the scans at which a component changes."""
        return [scan for scan, _ in sorted(self._rows[entity, component], key=lambda row: row[0])]

    def values(self, entity: str, component: str) -> list[Any]:
        """Return a component's values; each is a list, of one item for most components."""
        return [value for _, value in sorted(self._rows[entity, component], key=lambda row: row[0])]

    def singles(self, entity: str, component: str) -> np.ndarray:
        """Return the values of a component that has one item each time."""
        return np.array([value for (value,) in self.values(entity, component)])
