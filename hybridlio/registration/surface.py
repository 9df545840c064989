"""Point-to-plane matches of a scan with a surface, and the least-squares system of one Gauss-Newton step.

The residual of a scan point ``p`` matched to a plane with unit normal ``n`` through ``v`` is its signed distance

    ``r(ξ) = nᵀ(T·Exp(ξ)·p − v)``,  ``∂r/∂ω = (p × Rᵀn)ᵀ``,  ``∂r/∂v = (Rᵀn)ᵀ``  at ``ξ = (ω, v) = 0``.

It is robust by the Geman-McClure kernel ``ρ(r) = k²/2 · r²/(k² + r²)``, which is ``r²/2`` for small residuals and at
most ``k²/2``, so that a wrong match cannot pull without bound. Iteratively reweighted least squares gives each match
the weight

    ``w(r) = ρ'(r)/r = (k²/(k² + r²))²``:  1 at 0, a quarter at the kernel width ``k``, ``(k/r)⁴`` far outside.

A plane's own weight, smaller for a thick one (:mod:`hybridlio.cloud.plane_fitting`), multiplies that. The step
minimises ``½ Σ wᵢ (rᵢ + Jᵢ ξ)²``: Hessian ``Σ wᵢ JᵢᵀJᵢ``, gradient ``Σ wᵢ rᵢ Jᵢ``. Weights are taken as constant within
a step, and the normals' derivatives are zero because the planes belong to the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.kd_tree import GrowingKdTree
from hybridlio.core.arrays import Array
from hybridlio.registration.information import NORMAL_NOISE, NORMAL_NOISE_WEIGHTED, lever_arms

# Planes of this weight or more are thin: their thickness is below 5 cm, about twice the noise of a range (see the
# weight in hybridlio/cloud/plane_fitting.py). The others are bushes and the like, which have no front.
THIN_PLANE_WEIGHT = 0.9
# Sine of the angle under which the lidar may seem to be behind a plane that it sees: twice the usual tilt of normals,
# 0.045 rad (hybridlio/registration/information.py).
_LARGEST_FROM_BEHIND = 0.1


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """The weighted least squares of one Gauss-Newton step, for a right perturbation.

    Attributes:
        hessian, gradient: ``(6, 6)`` and ``(6,)`` of half the weighted squared distances.
        distances: ``(N,)`` of the points from their planes, metres, with sign.
        weights: ``(N,)``, between 0 and 1.
    """

    hessian: Array
    gradient: Array
    distances: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class PlaneMatches:
    """Scan points and the planes at their nearest neighbours, linearised at the pose at which they were matched.

    Attributes:
        pose: ``(4, 4)`` that pose.
        source: ``(N, 3)`` the points, scan frame.
        planes: ``(N, 5)`` normal n, offset n·v and weight, as :meth:`Surface.planes` returns them.
        rows: ``(7, N)`` the six derivatives of each distance, and the distance, metres.
    """

    pose: Array
    source: Array
    planes: Array
    rows: Array

    @classmethod
    def linearised(cls, pose: Array, source: Array, planes: Array) -> PlaneMatches:
        """Compute distances and derivatives at ``pose``."""
        normals = planes[:, :3]
        x, y, z = source.T
        a, b, c = (normals @ pose[:3, :3]).T  # the normals in the scan's frame
        rows = np.empty((7, len(source)))
        rows[0], rows[1], rows[2] = y * c - z * b, z * a - x * c, x * b - y * a
        rows[3], rows[4], rows[5] = a, b, c
        rows[6] = x * a + y * b + z * c + normals @ pose[:3, 3] - planes[:, 3]
        return cls(pose, source, planes, rows)

    def __len__(self) -> int:
        return len(self.source)

    def facing(self) -> PlaneMatches:
        """Return the matches without those of thin planes that the lidar would have to see from behind.

        Normals must point to where the planes were seen from.
        """
        x, y, z = self.source.T
        away_m = x * self.rows[3] + y * self.rows[4] + z * self.rows[5]
        ranges_m = np.sqrt(x * x + y * y + z * z)
        kept = (away_m < _LARGEST_FROM_BEHIND * ranges_m) | (self.planes[:, 4] < THIN_PLANE_WEIGHT)
        if kept.all():
            return self
        return PlaneMatches(self.pose, self.source[kept], self.planes[kept], self.rows[:, kept])

    @property
    def lever_arms_m(self) -> Array:
        """``(3,)`` of the points about the scan's axes, see :func:`hybridlio.registration.information.lever_arms`."""
        return lever_arms(self.source)

    def system(self, kernel_m: float, xi: Array | None = None) -> LinearSystem:
        """Return the step's system at the pose, or at ``pose·Exp(xi)`` for a small tangent vector ``xi`` ``(6,)``.

        Distances are extrapolated linearly to ``xi``: 1 mrad at 50 m is then wrong by 25 µm, far below the noise.
        """
        distances = self.rows[6] if xi is None else self.rows[6] + xi @ self.rows[:6]
        weights = self.planes[:, 4] * (kernel_m**2 / (kernel_m**2 + distances * distances)) ** 2
        weighted = self.rows[:6] * weights
        return LinearSystem(weighted @ self.rows[:6].T, weighted @ distances, distances, weights)


class Surface:
    """Points with planes and a k-d tree over them: the fixed side of a registration. Treated as immutable.

    Args:
        points: ``(M, 3)`` metres, at least one.
        normals: ``(M, 3)`` unit vectors.
        threads: for building the tree.
        weights: ``(M,)`` of the planes, see :func:`hybridlio.cloud.plane_fitting.fit_planes`; by default 1.
        base: a surface to extend: its points come first, and its tree is shared instead of built again.
        one_sided: normals point to where the planes were seen from, and from behind they are not matched. Else the two
            sides of a wall, as seen from two rooms, would attract each other's points.

    Attributes:
        points: ``(M, 3)`` all points, those of ``base`` first.
        one_sided: as given, or that of ``base``.
        normal_noise: spurious share of the information that its normals give.
    """

    def __init__(
        self,
        points: Array,
        normals: Array,
        threads: int = 2,
        weights: Array | None = None,
        base: Surface | None = None,
        one_sided: bool = False,
    ) -> None:
        planes = _planes(points, normals, weights)
        if base is None:
            self.points, self._planes, self._tree = points, planes, GrowingKdTree(points, threads)
            self.normal_noise = NORMAL_NOISE if weights is None else NORMAL_NOISE_WEIGHTED
            self.one_sided = one_sided
        else:
            self.points = np.concatenate([base.points, points])
            self._planes = np.concatenate([base._planes, planes])
            self._tree = base._tree.extended(self.points, threads)
            self.normal_noise, self.one_sided = base.normal_noise, base.one_sided

    def extended(self, points: Array, normals: Array, threads: int = 2, weights: Array | None = None) -> Surface:
        """Return a surface with more points after its own, cheaper than one built from all points."""
        return Surface(points, normals, threads, weights, base=self)

    @property
    def normals(self) -> Array:
        """``(M, 3)`` unit vectors."""
        return self._planes[:, :3]

    @property
    def appended_ratio(self) -> float:
        """Number of points added by :meth:`extended` over the number before; searches slow down as it grows."""
        return self._tree.appended_ratio

    def nearest(self, queries: Array, threads: int) -> tuple[NDArray[np.int64], Array]:
        """Return index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        return self._tree.nearest(queries, threads)

    def nearest_with_margin(self, queries: Array, threads: int) -> tuple[NDArray[np.int64], Array]:
        """Return each query's nearest point ``(N,)``, and how far ``(N,)`` the query may move before it can change.

        By the triangle inequality that is half the difference of the distances to the second nearest and the nearest
        point; it is infinite for a surface of one point.
        """
        index, first2, second2 = self._tree.two_nearest(queries, threads)
        return index, (np.sqrt(second2) - np.sqrt(first2)) / 2

    def planes(self, index: NDArray[np.int64]) -> Array:
        """Return ``(N, 5)`` for the given points: normal n, offset n·v, and weight."""
        return self._planes.take(index, axis=0)  # several times faster than indexing with brackets


def _planes(points: Array, normals: Array, weights: Array | None) -> Array:
    weights = np.ones(len(points)) if weights is None else weights
    return np.column_stack([normals, np.einsum("ij,ij->i", normals, points), weights])


class Neighbours:
    """Nearest surface points of a scan's points, followed while the scan's pose changes.

    Tree searches dominate the cost of a registration. A point that has moved less than its margin
    (:meth:`Surface.nearest_with_margin`) keeps its neighbour without a search; after a step of half a centimetre that
    applies to 14 of 15 points. The result is always the exact nearest neighbour.

    Args:
        surface: where neighbours are searched.
        source: ``(N, 3)`` the scan's points, scan frame.
        threads: for the search.
    """

    def __init__(self, surface: Surface, source: Array, threads: int) -> None:
        self._surface, self._source, self._threads = surface, source, threads
        self._searched: Array | None = None  # (N, 3) where each point was when its neighbour was last searched
        self._margin_m = np.empty(0)
        self._index = np.empty(0, np.int64)

    def matches(self, pose: Array, max_distance_m: float) -> PlaneMatches:
        """Match the points at a pose with planes; points without a neighbour within ``max_distance_m`` are left out."""
        index, source = self.within(pose, max_distance_m)
        return self._linearised(pose, source, self._surface.planes(index))

    def _linearised(self, pose: Array, source: Array, planes: Array) -> PlaneMatches:
        matches = PlaneMatches.linearised(pose, source, planes)
        return matches.facing() if self._surface.one_sided else matches

    def within(self, pose: Array, max_distance_m: float) -> tuple[NDArray[np.int64], Array]:
        """Return indices ``(M,)`` of the neighbours within a distance, and the scan points ``(M, 3)`` that have one."""
        moved = self._source @ pose[:3, :3].T + pose[:3, 3]
        self._update(moved)
        difference = moved - self._surface.points.take(self._index, axis=0)
        near = np.flatnonzero(np.einsum("ij,ij->i", difference, difference) < max_distance_m**2)
        index, source = self._index, self._source
        if len(near) < len(source):
            index, source = index[near], source.take(near, axis=0)
        return index, source

    def _update(self, moved: Array) -> None:
        """Search again for the points that have moved by their margin or more."""
        if self._searched is None:
            self._searched = moved
            self._index, self._margin_m = self._surface.nearest_with_margin(moved, self._threads)
            return
        displacement = moved - self._searched
        stale = np.flatnonzero(np.einsum("ij,ij->i", displacement, displacement) >= self._margin_m**2)
        if len(stale):
            self._searched[stale] = moved[stale]
            self._index[stale], self._margin_m[stale] = self._surface.nearest_with_margin(moved[stale], self._threads)
