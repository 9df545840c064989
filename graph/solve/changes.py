"""Changes of a pose graph since an online solver last read it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from hybridlio.core.errors import GraphError
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes since the last update.

    Attributes:
        poses: indices of new poses.
        edge_rows: new rows of the edge table.
        other_factors: other new factors by id, ascending.
        removed: ids of factors that were removed.
        fixed: keys of poses that were fixed.
        unfixed: keys of poses that were released.
    """

    poses: range
    edge_rows: slice
    other_factors: dict[int, Factor]
    removed: list[int]
    fixed: list[Key]
    unfixed: list[Key]

    def __bool__(self) -> bool:
        changed = self.other_factors or self.removed or self.fixed or self.unfixed
        return bool(len(self.poses) or self.edge_rows.start < self.edge_rows.stop or changed)

    def of_kind(self, *kinds: str) -> list[Factor]:
        """Return the new factors of some kinds, between-factors excepted."""
        return [factor for factor in self.other_factors.values() if factor.kind in kinds]


def check_followed(data: GraphData) -> None:
    """Raise GraphError where a graph has what online solvers do not follow: calibration variables.

    One is shared by all factors of a sensor: whenever it is linearised anew, iSAM2 eliminates the whole graph again, so
    that an update costs what a batch does.
    """
    if data.calibrations:
        raise GraphError("online solvers take no calibration variables; solve the graph by optimize()")


class ChangeTracker:
    """Finds changes in constant time each; only where factors were removed it goes through all."""

    def __init__(self, data: GraphData) -> None:
        self._data = data
        self._poses, self._next_id = 0, 0
        self._fixed: frozenset[Key] = frozenset()
        self._ids: set[int] = set()

    def read(self) -> Changes:
        """Return the changes since the last :meth:`accept`.

        Raises:
            GraphError: the graph has calibration variables.
        """
        data = self._data
        check_followed(data)
        first = int(np.searchsorted(data.edges.ids, self._next_id))
        newest = takewhile(lambda factor_id: factor_id >= self._next_id, reversed(data.other_factors))
        others = {factor_id: data.other_factors[factor_id] for factor_id in sorted(newest)}
        kept = len(data.factors) - (len(data.edges) - first) - len(others)
        removed = (
            [factor_id for factor_id in self._ids if factor_id not in data.factors] if kept < len(self._ids) else []
        )
        fixed = data.fixed
        return Changes(
            range(self._poses, len(data)), slice(first, len(data.edges)), others, removed,
            sorted(fixed - self._fixed, key=data.index.__getitem__), list(self._fixed - fixed),
        )  # fmt: skip

    def accept(self, changes: Changes) -> None:
        """Count the changes as known."""
        self._poses, self._next_id = changes.poses.stop, self._data.next_id
        self._ids.update(self._data.edges.ids[changes.edge_rows].tolist(), changes.other_factors)
        self._ids.difference_update(changes.removed)
        self._fixed = self._data.fixed

    def forget(self, ids: set[int]) -> None:
        """Ignore the removal of some factors from now on."""
        self._ids -= ids
