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
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.kd_tree import GrowingKdTree
from hybridlio.core.arrays import Array
from hybridlio.registration.information import NORMAL_NOISE, NORMAL_NOISE_WEIGHTED, lever_arms

if TYPE_CHECKING:
    from hybridlio.registration.loops import Rows, Sums
    from hybridlio.registration.match_loops import Candidates

# Of the matching distance, along the plane: a voxel of the map at the default settings. A map without gaps has a point
# in each voxel that it has seen. A point whose neighbour is farther aside lies where nothing has been seen yet, and the
# plane at the edge, continued to there, is a guess. Matches with edges are commonly left out: Turk and Levoy, "Zippered
# polygon meshes from range images", SIGGRAPH 1994. With a rosette in rooms and mines errors are then 0.8 times as
# large, and with 0.4 in place of 0.6 they are 0.9 times. Between the rings of spinning lidars neighbours lie as far
# aside everywhere: with 16 beams the drift on roads is 1.13 times as large without these.
_ASIDE_SHARE = 0.6
# Nearest points that are kept of each query: four take 1.4 times as long to find as two, and the query may move four
# times as far (3 to 9 cm in rooms and streets) without a search.
_CANDIDATES = 4
NO_POINTS = (np.empty((7, 3, 0)), np.empty(0))  # of matches with planes alone


@dataclass(frozen=True, eq=False)
class PlaneMatches:
    """Scan points and the planes at their nearest neighbours, linearised at the pose at which they were matched.

    Attributes:
        pose: ``(4, 4)`` that pose.
        source: ``(N, 3)`` the points, scan frame.
        planes: ``(N, 5)`` normals n, offsets n·v and weights, as :meth:`Surface.planes` returns them.
        rows: derivatives and distances, metres.
    """

    pose: Array
    source: Array
    planes: Array
    rows: Rows

    @classmethod
    def linearised(cls, pose: Array, source: Array, planes: Array) -> PlaneMatches:
        """Compute distances and derivatives at ``pose``."""
        from hybridlio.registration import loops, match_loops  # late: compiled

        source, planes = np.ascontiguousarray(source), np.ascontiguousarray(planes)
        rows = match_loops.linearise(np.ascontiguousarray(pose), source, planes)
        return cls(pose, source, planes, loops.Rows(rows, planes[:, 4].copy(), *NO_POINTS))

    def __len__(self) -> int:
        return len(self.source)

    @property
    def distances(self) -> Array:
        """``(N,)`` of the points from their planes, metres, with sign."""
        return np.asarray(self.rows.planes[6])

    @property
    def lever_arms_m(self) -> Array:
        """``(3,)`` of the points about the scan's axes, see :func:`hybridlio.registration.information.lever_arms`."""
        return lever_arms(self.source)

    def system(self, kernel_m: float, xi: Array | None = None) -> Sums:
        """Return the step's least squares at the pose, or at ``pose·Exp(xi)`` for a small vector ``xi`` ``(6,)``.

        Distances are extrapolated linearly to ``xi``: 1 mrad at 50 m is then wrong by 25 µm, far below the noise.
        """
        from hybridlio.registration import loops  # late: compiled

        return loops.system(self.rows, np.zeros(6) if xi is None else xi, kernel_m, kernel_m)


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
        all_planes: ``(M, 5)`` of all points: normal n, offset n·v, and weight.
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
            self.points, self.all_planes, self._tree = points, planes, GrowingKdTree(points, threads)
            self.normal_noise = NORMAL_NOISE if weights is None else NORMAL_NOISE_WEIGHTED
            self.one_sided = one_sided
        else:
            self.points = np.concatenate([base.points, points])
            self.all_planes = np.concatenate([base.all_planes, planes])
            self._tree = base._tree.extended(self.points, threads)
            self.normal_noise, self.one_sided = base.normal_noise, base.one_sided

    def extended(self, points: Array, normals: Array, threads: int = 2, weights: Array | None = None) -> Surface:
        """Return a surface with more points after its own, cheaper than one built from all points."""
        return Surface(points, normals, threads, weights, base=self)

    @property
    def normals(self) -> Array:
        """``(M, 3)`` unit vectors."""
        return self.all_planes[:, :3]

    @property
    def appended_ratio(self) -> float:
        """Number of points added by :meth:`extended` over the number before; searches slow down as it grows."""
        return self._tree.appended_ratio

    def nearest(self, queries: Array, threads: int) -> tuple[NDArray[np.int64], Array]:
        """Return index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        return self._tree.nearest(queries, threads)

    def candidates(self, queries: Array, threads: int) -> Candidates:
        """Return each query's nearest points, and how far it may move until others may be nearer.

        By the triangle inequality that is half the difference of the distances to another point and to the nearest; it
        is infinite where there is no other.
        """
        from hybridlio.registration.match_loops import Candidates  # late: compiled

        index, distance2, others2 = self._tree.several_nearest(queries, _CANDIDATES, threads)
        nearest_m, others_m = np.sqrt(distance2[:, 0]), np.sqrt(others2)
        second_m = np.minimum(np.sqrt(distance2[:, 1]), others_m)
        return Candidates(index, (second_m - nearest_m) / 2, (others_m - nearest_m) / 2)

    def planes(self, index: NDArray[np.int64]) -> Array:
        """Return ``(N, 5)`` for the given points: normal n, offset n·v, and weight."""
        return self.all_planes.take(index, axis=0)  # several times faster than indexing with brackets


def _planes(points: Array, normals: Array, weights: Array | None) -> Array:
    weights = np.ones(len(points)) if weights is None else weights
    return np.column_stack([normals, np.einsum("ij,ij->i", normals, points), weights])


class Neighbours:
    """Nearest surface points of a scan's points, followed while the scan's pose changes.

    Tree searches dominate the cost of a registration. A point that has moved less than its candidates allow is
    compared with these few alone. The result is always the exact nearest neighbour.

    Args:
        surface: where neighbours are searched.
        source: ``(N, 3)`` the scan's points, scan frame.
        threads: for the search.
        without_edges: leave out points beyond the edge of what the surface shows; it must have no gaps between rings.

    Attributes:
        surface: as given.
    """

    def __init__(self, surface: Surface, source: Array, threads: int, without_edges: bool = False) -> None:
        self.surface, self._source, self._threads = surface, np.ascontiguousarray(source), threads
        self._aside_share = _ASIDE_SHARE if without_edges else np.inf
        self._searched: Array | None = None  # (N, 3) where each point was when its neighbour was last searched
        self._candidates: Candidates
        self._index = np.empty(0, np.int64)

    def matches(self, pose: Array, max_distance_m: float) -> PlaneMatches:
        """Match the points at a pose with planes; points without a neighbour within ``max_distance_m`` are left out."""
        index, source = self._near(pose, max_distance_m, self.surface.one_sided)
        return PlaneMatches.linearised(pose, source, self.surface.planes(index))

    def within(self, pose: Array, max_distance_m: float) -> tuple[NDArray[np.int64], Array]:
        """Return indices ``(M,)`` of the neighbours within a distance, and the scan points ``(M, 3)`` that have one."""
        return self._near(pose, max_distance_m, one_sided=False)

    def __len__(self) -> int:
        return len(self._source)

    def _near(self, pose: Array, max_distance_m: float, one_sided: bool) -> tuple[NDArray[np.int64], Array]:
        from hybridlio.registration import match_loops  # late: compiled

        pose = np.ascontiguousarray(pose)
        self._update(pose)
        surface, index, source = self.surface, self._index, self._source
        reach = match_loops.Reach(max_distance_m, self._aside_share * max_distance_m, one_sided)
        kept = match_loops.near(pose, source, index, surface.points, surface.all_planes, reach)
        return (index, source) if len(kept) == len(source) else (index.take(kept), source.take(kept, axis=0))

    def costs(self, pose: Array, kernel_m: float, max_distance_m: float) -> Array:
        """Return the robust cost ``(N,)`` of each point at a pose, 0 to 1; NaN without a neighbour in the distance."""
        from hybridlio.registration import match_loops  # late: compiled

        pose = np.ascontiguousarray(pose)
        self._update(pose)
        of_surface = self.surface.points, self.surface.all_planes
        return match_loops.costs(pose, self._source, self._index, *of_surface, max_distance_m, kernel_m)

    def _update(self, pose: Array) -> None:
        """Follow the points to a pose, and search again for those that have moved too far."""
        from hybridlio.registration import match_loops  # late: compiled

        if self._searched is None:
            self._searched = self._source @ pose[:3, :3].T + pose[:3, 3]
            self._candidates = self.surface.candidates(self._searched, self._threads)
            self._index = self._candidates.nearest[:, 0].copy()
            return
        candidates, points = self._candidates, self.surface.points
        which, queries = match_loops.follow(pose, self._source, self._searched, candidates, points, self._index)
        if len(which):
            for kept, found in zip(candidates, self.surface.candidates(queries, self._threads), strict=True):
                kept[which] = found
            self._index[which] = candidates.nearest[which, 0]
