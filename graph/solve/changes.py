"""What has come to a pose graph, and gone from it, since an online solver last looked."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor


@dataclass(frozen=True, eq=False)
class News:
    """Since the last update.

    Attributes:
        poses: places of new poses.
        rows: new rows of the table of between-factors.
        others: other new factors by id, in order.
        gone: ids of factors that were taken out.
        fixed, freed: keys that are held, or no longer.
    """

    poses: range
    rows: slice
    others: dict[int, Factor]
    gone: list[int]
    fixed: list[Key]
    freed: list[Key]

    def __bool__(self) -> bool:
        changed = self.others or self.gone or self.fixed or self.freed
        return bool(len(self.poses) or self.rows.start < self.rows.stop or changed)


class Reader:
    """Reads what is new in constant time; only where factors were taken out it looks at all."""

    def __init__(self, data: GraphData) -> None:
        self._data = data
        self._poses, self._next_id = 0, 0
        self._fixed: frozenset[Key] = frozenset()
        self._ids: set[int] = set()

    def read(self) -> News:
        """What is new; the same again until :meth:`took`."""
        data = self._data
        first = int(np.searchsorted(data.edges.ids, self._next_id))
        newest = takewhile(lambda number: number >= self._next_id, reversed(data.others))
        others = {number: data.others[number] for number in sorted(newest)}
        old = len(data.factors) - (len(data.edges) - first) - len(others)
        gone = [number for number in self._ids if number not in data.factors] if old < len(self._ids) else []
        fixed = data.fixed
        return News(
            range(self._poses, len(data)), slice(first, len(data.edges)), others, gone,
            sorted(fixed - self._fixed, key=data.places.__getitem__), list(self._fixed - fixed),
        )  # fmt: skip

    def took(self, news: News) -> None:
        """Count it as known."""
        self._poses, self._next_id = news.poses.stop, self._data.next_id
        self._ids.update(self._data.edges.ids[news.rows].tolist(), news.others)
        self._ids.difference_update(news.gone)
        self._fixed = self._data.fixed

    def forget(self, ids: set[int]) -> None:
        """Count factors as never there, though they may be in the graph."""
        self._ids -= ids
