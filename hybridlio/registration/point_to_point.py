"""Matches that take for points what is too thick for a plane: trunks, bushes, leaves.

A plane through ten points on a trunk leans anywhere, and all that its distances can tell is a decimetre. Where two
scans hit the same trunk, their points lie centimetres apart, in all directions at once; a kernel over the whole
distance tells them from those that lie beside others by chance, which one over each direction's would not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.registration.information import lever_arms
from hybridlio.registration.surface import Matches, Neighbours, System

_A_PLANE = 0.9  # counts so much and more: it is less than 5 cm thick


@dataclass(frozen=True, eq=False)
class MixedMatches:
    """Points of a scan with the planes or the points that they lie nearest to.

    Attributes:
        planes: those with planes.
        source: ``(M, 3)`` the others, scan frame.
        rows: ``(7, 3, M)`` derivatives by a right perturbation of what they are off, scan frame, and what they are off.
        weights: ``(M,)`` how much each counts.
    """

    planes: Matches
    source: Array
    rows: Array
    weights: Array

    @classmethod
    def of(cls, planes: Matches, source: Array, targets: Array, weights: Array) -> MixedMatches:
        """Linearised at the pose of ``planes``; ``targets`` ``(M, 3)`` are the other points' neighbours."""
        x, y, z = source.T
        rows = np.zeros((7, 3, len(source)))
        rows[0, 1], rows[0, 2] = -z, y
        rows[1, 0], rows[1, 2] = z, -x
        rows[2, 0], rows[2, 1] = -y, x
        rows[3, 0] = rows[4, 1] = rows[5, 2] = 1.0
        rows[6] = (source + (planes.pose[:3, 3] - targets) @ planes.pose[:3, :3]).T
        return cls(planes, source, rows, weights)

    def __len__(self) -> int:
        return len(self.planes) + len(self.source)

    @property
    def levers_m(self) -> Array:
        """``(3,)`` of all points about the scan's axes, see :func:`hybridlio.registration.information.lever_arms`."""
        return lever_arms(np.concatenate([self.planes.source, self.source]))

    def system(self, kernel_m: float, xi: Array | None = None) -> System:
        """The step's equations, as of :meth:`Matches.system`; the thick may be off by more."""
        flat = self.planes.system(kernel_m, xi)
        off = self.rows[6] if xi is None else self.rows[6] + np.tensordot(xi, self.rows[:6], 1)
        squares = np.einsum("ij,ij->j", off, off)
        weights = self.weights * (kernel_m**2 / (kernel_m**2 + self.weights * squares)) ** 2
        derivatives = self.rows[:6].reshape(6, -1)
        weighted = derivatives * np.tile(weights, 3)
        return System(
            flat.hessian + weighted @ derivatives.T,
            flat.gradient + weighted @ off.ravel(),
            np.concatenate([flat.distances, np.sqrt(squares)]),
            np.concatenate([flat.weights, weights]),
        )


class MixedNeighbours(Neighbours):
    """As :class:`hybridlio.registration.surface.Neighbours`, of planes or points."""

    def mixed(self, pose: Array, reach_m: float) -> MixedMatches:
        """The planes or points of the points at a pose; points without a neighbour within reach are left out."""
        index, source = self.within(pose, reach_m)
        planes = self._surface.planes(index)
        flat = planes[:, 4] >= _A_PLANE
        targets = self._surface.points.take(index[~flat], axis=0)
        return MixedMatches.of(Matches.of(pose, source[flat], planes[flat]), source[~flat], targets, planes[~flat, 4])
