"""Between-factors by column, as a pose graph keeps them: most work is done on all of them at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Array
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor, Form, Noise, Robust

FORMS: tuple[Form, ...] = ("covariance", "information", "sigmas")
_LEAST_ROOM = 16


class Rows:
    """An array that rows are added to at its end, in constant time each."""

    def __init__(self, shape: tuple[int, ...], dtype: Any = np.float64) -> None:
        self._room = np.empty((0, *shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> NDArray[Any]:
        """The rows so far; the next change may take the memory away from under it."""
        return self._room[: self._count]

    def extend(self, rows: ArrayLike) -> None:
        """Add rows."""
        rows = np.asarray(rows, dtype=self._room.dtype)
        need = self._count + len(rows)
        if need > len(self._room):
            room = np.empty((max(need, 2 * self._count, _LEAST_ROOM), *self._room.shape[1:]), dtype=self._room.dtype)
            room[: self._count] = self.array
            self._room = room
        self._room[self._count : need] = rows
        self._count = need

    def where(self, keep: NDArray[np.bool_] | slice) -> Rows:
        """A copy of some rows."""
        copy = Rows(self._room.shape[1:], self._room.dtype)
        copy._room = np.array(self.array[keep])
        copy._count = len(copy._room)
        return copy


class EdgeTable:
    """Columns of ids, both ends' places, measured coordinates, noise and its form; kernels by id."""

    def __init__(self, dimension: co.Dimension) -> None:
        size = co.TANGENT_SIZE[dimension]
        self._columns = {
            "id": Rows((), np.int64),
            "ends": Rows((2,), np.int64),
            "measured": Rows(co.IDENTITY[dimension].shape),
            "noise": Rows((size, size)),  # sigmas stand on the diagonal
            "form": Rows((), np.int8),
        }
        self.robust: dict[int, Robust] = {}
        self._made: dict[int, Factor] = {}

    def __len__(self) -> int:
        return len(self._columns["id"])

    def __contains__(self, number: object) -> bool:
        return isinstance(number, int | np.integer) and self._row(int(number)) is not None

    @property
    def ids(self) -> NDArray[np.int64]:
        """``(M,)``, rising."""
        return self._columns["id"].array

    @property
    def ends(self) -> NDArray[np.int64]:
        """``(M, 2)`` places of the poses in the graph's order."""
        return self._columns["ends"].array

    @property
    def measured(self) -> Array:
        """``(M, 7)`` or ``(M, 3)`` coordinates."""
        return self._columns["measured"].array

    @property
    def noise(self) -> Array:
        """``(M, d, d)`` as given, each in its form; sigmas on the diagonal."""
        return self._columns["noise"].array

    @property
    def form(self) -> NDArray[np.int8]:
        """``(M,)`` which of :data:`FORMS`."""
        return self._columns["form"].array

    @property
    def information(self) -> Array:
        """``(M, d, d)``."""
        information = self.noise
        others = np.flatnonzero(self.form != FORMS.index("information"))
        if len(others):
            information = information.copy()
        for row in others:
            information[row] = self._noise(int(row)).information
        return information

    def extend(
        self, ids: ArrayLike, ends: ArrayLike, measured: ArrayLike, noise: ArrayLike, form: ArrayLike
    ) -> None:  # fmt: skip
        """Add rows whose ids are higher than all that are there."""
        for rows, values in zip(self._columns.values(), (ids, ends, measured, noise, form), strict=True):
            rows.extend(values)

    def append(self, number: int, ends: tuple[int, int], factor: Factor) -> None:
        """Add one."""
        assert factor.noise is not None
        noise = factor.noise
        values = np.diag(noise.values) if noise.form == "sigmas" else noise.values
        self.extend([number], [ends], factor.measured[None], values[None], [FORMS.index(noise.form)])
        if factor.robust is not None:
            self.robust[number] = factor.robust

    def remove(self, number: int) -> None:
        """Take one out that is there."""
        keep = self.ids != number
        self._columns = {name: rows.where(keep) for name, rows in self._columns.items()}
        self.robust.pop(number, None)
        self._made.pop(number, None)

    def where(self, keep: NDArray[np.bool_] | slice) -> EdgeTable:
        """A copy of some rows."""
        copy = EdgeTable.__new__(EdgeTable)
        copy._columns = {name: rows.where(keep) for name, rows in self._columns.items()}
        left = self.robust.keys() & copy.ids.tolist() if self.robust else ()
        copy._made = {}
        copy.robust = {number: self.robust[number] for number in left}
        return copy

    def factor(self, number: int, keys: list[Key]) -> Factor:
        """One as an object.

        Raises:
            KeyError: there is none of this id.
        """
        row = self._row(number)
        if row is None:
            raise KeyError(number)
        if number not in self._made:
            i, j = self.ends[row].tolist()
            measured, robust = self.measured[row].copy(), self.robust.get(number)
            self._made[number] = Factor("between", (keys[i], keys[j]), measured, self._noise(row), robust)
        return self._made[number]

    def _noise(self, row: int) -> Noise:
        form, values = FORMS[self.form[row]], self.noise[row]
        return Noise(form, np.diagonal(values).copy() if form == "sigmas" else values.copy())

    def _row(self, number: int) -> int | None:
        row = int(np.searchsorted(self.ids, number))
        return row if row < len(self) and self.ids[row] == number else None
