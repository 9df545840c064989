"""Between-factors stored by column, because most work is done on all of them at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.growing_array import GrowingArray
from hybridlio.graph.model.noise import Form, Noise, Robust

FORMS: tuple[Form, ...] = ("covariance", "information", "sigmas")


class EdgeTable:
    """Between-factors by row: id, both poses, measured coordinates, noise and its form.

    Attributes:
        robust: kernels by factor id, of the edges that have one.
    """

    def __init__(self, dimension: co.Dimension) -> None:
        self._dimension = dimension
        size = co.TANGENT_SIZE[dimension]
        self._columns = {
            "id": GrowingArray((), np.int64),
            "ends": GrowingArray((2,), np.int64),
            "measured": GrowingArray(co.IDENTITY[dimension].shape),
            "noise": GrowingArray((size, size)),
            "form": GrowingArray((), np.int8),
        }
        self.robust: dict[int, Robust] = {}

    def __len__(self) -> int:
        return len(self._columns["id"])

    def __contains__(self, factor_id: object) -> bool:
        return isinstance(factor_id, int | np.integer) and self.row(int(factor_id)) is not None

    @property
    def ids(self) -> Index:
        """Factor ids ``(M,)``, ascending."""
        return self._columns["id"].array

    @property
    def ends(self) -> Index:
        """Indices ``(M, 2)`` of both poses in the graph's order."""
        return self._columns["ends"].array

    @property
    def measured(self) -> Array:
        """Coordinates ``(M, 7)`` or ``(M, 3)`` of ``T_i_j``."""
        return self._columns["measured"].array

    @property
    def noise_values(self) -> Array:
        """Noise ``(M, d, d)``, each in the form it was given; sigmas are on the diagonal."""
        return self._columns["noise"].array

    def noise_bytes(self, rows: slice) -> list[bytes]:
        """Return the bytes of the noise of some rows, by which equal noise is found, in one call for all."""
        values = self.noise_values[rows]
        flat = values.reshape(-1, values.shape[1] * values.shape[2])
        found: list[bytes] = flat.view(f"V{flat.itemsize * flat.shape[1]}")[:, 0].tolist()
        return found

    @property
    def form(self) -> NDArray[np.int8]:
        """Form of the noise ``(M,)``, an index into :data:`FORMS`."""
        return self._columns["form"].array

    @property
    def information(self) -> Array:
        """Information matrices ``(M, d, d)``."""
        information = self.noise_values
        others = np.flatnonzero(self.form != FORMS.index("information"))
        if len(others):
            information = information.copy()
        for row in others:
            information[row] = self.noise(int(row)).information
        return information

    def noise(self, row: int) -> Noise:
        """Return the noise of a row as an object."""
        form, values = FORMS[self.form[row]], self.noise_values[row]
        return Noise(form, np.diagonal(values).copy() if form == "sigmas" else values.copy())

    def row(self, factor_id: int) -> int | None:
        """Return the row of a factor, or None where the table does not hold it."""
        row = int(np.searchsorted(self.ids, factor_id))
        return row if row < len(self) and self.ids[row] == factor_id else None

    def extend(
        self, ids: ArrayLike, ends: ArrayLike, measured: ArrayLike, noise: ArrayLike, form: ArrayLike
    ) -> None:  # fmt: skip
        """Add rows whose ids are higher than all in the table."""
        for column, values in zip(self._columns.values(), (ids, ends, measured, noise, form), strict=True):
            column.extend(values)

    def append(
        self, factor_id: int, ends: tuple[int, int], measured: Array, noise: Noise, robust: Robust | None
    ) -> None:  # fmt: skip
        """Add one row."""
        values = np.diag(noise.values) if noise.form == "sigmas" else noise.values
        self.extend([factor_id], [ends], measured[None], values[None], [FORMS.index(noise.form)])
        if robust is not None:
            self.robust[factor_id] = robust

    def remove(self, factor_id: int) -> None:
        """Remove the row of a factor that the table holds."""
        keep = self.ids != factor_id
        self._columns = {name: column.where(keep) for name, column in self._columns.items()}
        self.robust.pop(factor_id, None)

    def where(self, keep: Mask | slice) -> EdgeTable:
        """Return a copy of some rows."""
        copy = EdgeTable(self._dimension)
        copy._columns = {name: column.where(keep) for name, column in self._columns.items()}
        kept = self.robust.keys() & copy.ids.tolist() if self.robust else ()
        copy.robust = {factor_id: self.robust[factor_id] for factor_id in kept}
        return copy
