"""Loops that confirm one another: which they are, and how far the stated noise is from the errors that they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.smoothing.loop_consistency import LoopArrays, cycle_chi2

# Poses between the ends of two loops that are compared: over so short a stretch odometry has hardly drifted, so that
# two loops agree by chance in few of all places.
_REACH = 10
_PAIRS_PER_LOOP = 20  # at most, on average: the median of χ² over twenty neighbours is known well enough
_PAIRS_FOR_SCALE = 10  # fewer do not tell the noise
# Factor on the noise that pairs show: two stretches of odometry and two loops average out what one loop does not, and
# the median over pairs lies below that of the largest errors; twice the standard deviation.
_SCALE_MARGIN = 4.0


@dataclass(frozen=True, eq=False)
class LoopSupport:
    """What pairs of neighbouring loops say.

    Attributes:
        scale: factor, at most 1, by which to lower χ² bounds where all noise is stated much larger than it is.
        supported: ``(M,)`` whether a loop agrees with a neighbour.
        cluster: ``(M,)`` number of the loop's cluster: loops that agree with one another, directly or through others.
    """

    scale: float
    supported: Mask
    cluster: Index


class GraphOdometry:
    """Relative poses along the odometry of a graph and their covariances, by rank: the place in the order of keys.

    Errors of different steps are taken as independent.

    Args:
        data: the graph.
        odometry: its between-factors of consecutive keys; those of the first measurement count.
        poses: ``(N, 4, 4)`` along the odometry, in the graph's order.
    """

    def __init__(self, data: GraphData, odometry: Edges, poses: Array) -> None:
        pairs = np.array([(-1, key) if isinstance(key, int) else key for key in data.keys], dtype=np.int64)
        order = np.lexsort(pairs.reshape(-1, 2).T[::-1])
        self.rank = np.empty(len(order), dtype=np.int64)
        self.rank[order] = np.arange(len(order))
        self._poses = poses[order]
        i, j = self.rank[odometry.i], self.rank[odometry.j]
        covariances = spatial(np.asarray(np.linalg.inv(odometry.information), dtype=np.float64), unmeasured=0.0)
        covariances = np.where(
            (i < j)[:, None, None], covariances, se3.rotate_covariance(covariances, odometry.T)
        )  # a step measured backwards
        steps, joined = np.zeros((len(order), 6, 6)), np.zeros(len(order), dtype=bool)
        later = np.maximum(i, j)
        steps[later], joined[later] = se3.rotate_covariance(covariances, self._poses[later]), True
        self._sums = np.cumsum(steps, axis=0)
        self._piece = np.cumsum(~joined)

    def relative(self, i: Index, j: Index) -> Array:
        """Return the pose ``(…, 4, 4)`` of rank ``j`` in that of rank ``i``."""
        return se3.between(self._poses[i], self._poses[j])

    def covariance(self, i: Index, j: Index) -> Array:
        """Return the covariance ``(…, 6, 6)`` of :meth:`relative`, of right perturbations, rotation first."""
        world = self._sums[np.maximum(i, j)] - self._sums[np.minimum(i, j)]
        return se3.rotate_covariance(world, se3.inverse(self._poses[j]))

    def joined(self, i: Index, j: Index) -> Mask:
        """Whether odometry leads from one rank to the other without a gap."""
        return np.asarray(self._piece[i] == self._piece[j])


def spatial(covariances: Array, unmeasured: float) -> Array:
    """Return planar covariances ``(M, 3, 3)`` as ``(M, 6, 6)`` with a variance for what the plane leaves out."""
    if covariances.shape[1] == 6:
        return covariances
    out = np.tile(np.diag([unmeasured, unmeasured, 0, 0, 0, unmeasured]), (len(covariances), 1, 1))
    out[:, 2:5, 2:5] = covariances
    return out


def loop_support(loops: Edges, odometry: GraphOdometry, bound: float) -> LoopSupport:
    """Compare each loop with its neighbours: two loops and the odometry between their ends form a cycle.

    Args:
        loops: ``M`` of them.
        odometry: of the graph.
        bound: χ² up to which a loop counts as correct, with the noise as stated.
    """
    count, size = len(loops.i), loops.information.shape[1]
    pairs, chi2 = _neighbours(loops, odometry)
    if len(pairs) < _PAIRS_FOR_SCALE:
        return LoopSupport(1.0, np.zeros(count, dtype=bool), _clusters(pairs[chi2 <= bound], count))
    medians = _medians(np.concatenate([pairs, pairs[:, ::-1]])[:, 0], np.concatenate([chi2, chi2]))
    typical = size - 2 / 3  # median of χ², by Wilson and Hilferty
    scale = min(1.0, _SCALE_MARGIN * float(np.median(medians)) / typical)
    agreeing = pairs[chi2 <= scale * bound]
    supported = np.zeros(count, dtype=bool)
    supported[agreeing] = True
    return LoopSupport(scale, supported, _clusters(agreeing, count))


def _clusters(pairs: Index, count: int) -> Index:
    """Return the number of the cluster ``(count,)`` of each loop, where pairs ``(K, 2)`` belong together."""
    joined = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def _neighbours(loops: Edges, odometry: GraphOdometry) -> tuple[Index, Array]:
    """Return pairs ``(K, 2)`` of loops whose ends lie near each other along the odometry, and χ² of their cycles."""
    i, j = odometry.rank[loops.i], odometry.rank[loops.j]
    forward = i < j
    covariances = np.asarray(np.linalg.inv(loops.information), dtype=np.float64)
    covariances = spatial(covariances, unmeasured=1.0)  # any: the error there is zero
    poses = np.where(forward[:, None, None], loops.T, se3.inverse(loops.T))
    covariances = np.where(forward[:, None, None], covariances, se3.rotate_covariance(covariances, loops.T))
    arrays = LoopArrays(np.minimum(i, j), np.maximum(i, j), poses, covariances)
    ends = np.column_stack([arrays.earlier, arrays.later])
    pairs = cKDTree(ends).query_pairs(_REACH, p=np.inf, output_type="ndarray")
    most = _PAIRS_PER_LOOP * len(i)
    if len(pairs) > most:
        pairs = pairs[np.random.default_rng(0).choice(len(pairs), most, replace=False)]
    a, b = pairs.T
    same_piece = odometry.joined(ends[a, 0], ends[b, 0]) & odometry.joined(ends[a, 1], ends[b, 1])
    pairs = pairs[same_piece]
    return pairs, cycle_chi2(arrays, pairs[:, 0], pairs[:, 1], odometry, 1.0)


def _medians(group: Index, values: Array) -> Array:
    """Return the lower median of the values of each group."""
    order = np.lexsort((values, group))
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    counts = np.diff(np.append(first, len(group)))
    return np.asarray(values[order][first + (counts - 1) // 2])
