"""What marginalised poses say about the others, as plain numbers: one linear factor around fixed coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.graph.model import coordinates as co


@dataclass(frozen=True, eq=False)
class Marginal:
    """The factor ``|A·ξ - b|²`` of ``k`` poses, which have moved by ``ξ`` from where they were.

    Attributes:
        coordinates: ``(k, 7)`` or ``(k, 3)``, of the poses.
        A: ``(r, k·d)``, of right perturbations in GTSAM's order.
        b: ``(r,)``.
    """

    coordinates: Array
    A: Array
    b: Array

    def packed(self) -> Array:
        """Return all numbers in a row, as :attr:`hybridlio.graph.model.measurements.Factor.measured`."""
        return np.concatenate([self.coordinates.ravel(), self.A.ravel(), self.b])

    @classmethod
    def unpacked(cls, numbers: Array, poses: int, dimension: co.Dimension, name: str) -> Marginal:
        """Return the factor of some poses; raise DataError where the numbers do not fit."""
        size, tangent = len(co.IDENTITY[dimension]), poses * co.TANGENT_SIZE[dimension]
        rows, rest = divmod(len(numbers) - poses * size, tangent + 1)
        if rest or rows < 1 or not np.isfinite(numbers).all():
            raise DataError(f"{name}: {len(numbers)} numbers are no marginal of {poses} poses")
        at, A, b = np.split(numbers, [poses * size, poses * size + rows * tangent])
        return cls(at.reshape(poses, size), A.reshape(rows, tangent), b)

    def moved(self, coordinates: Sequence[float] | Array) -> Marginal:
        """Return the factor around other coordinates of its poses."""
        return Marginal(np.asarray(coordinates), self.A, self.b)
