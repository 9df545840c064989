"""A graph whose unbranched stretches of odometry are one factor each: searches then solve what loops concern alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.edge_table import FORMS
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.loop_support import GraphOdometry


@dataclass(frozen=True, eq=False)
class Condensed:
    """The poses between which more than one stretch of odometry leads, with everything that concerns them.

    A pose that only the steps before and after it concern adds nothing: its two steps are composed, and their
    covariances propagated to first order. The result has the least cost of the whole graph, to first order.

    Attributes:
        trusted: the graph without loops.
        loops: its loops, between the poses of ``trusted``.
        kept: ``(K,)`` places of its poses in the whole graph.
    """

    trusted: GraphData
    loops: Edges
    odometry: Edges
    kept: Index
    _chain: GraphOdometry

    def expand(self, coordinates: Array) -> Array:
        """Return coordinates of all poses of the whole graph, from those ``(K, d)`` of the kept ones.

        A stretch whose ends have moved bends along its length.
        """
        poses, chain = co.to_matrices(coordinates), self._chain
        ranks = chain.rank[self.kept]
        order = np.argsort(ranks)
        everything = np.arange(len(chain.rank))
        after = np.minimum(np.searchsorted(ranks[order], everything), len(order) - 1)
        before = np.maximum(np.searchsorted(ranks[order], everything, side="right") - 1, 0)
        a, b = ranks[order][before], ranks[order][after]
        T_a, T_b = poses[order][before], poses[order][after]
        between = (a < everything) & (everything < b)
        share = np.where(between, (everything - a) / np.maximum(b - a, 1), np.where(everything >= b, 1.0, 0.0))
        open_end = ~chain.joined(everything, b)
        bend = se3.log(se3.between(T_a @ chain.relative(a, b), T_b))
        share, bend = np.where(open_end, 0.0, share), np.where(open_end[:, None], 0.0, bend)
        at = T_a @ chain.relative(a, b) @ se3.exp(share[:, None] * bend) @ chain.relative(b, everything)
        at = np.where((everything < a)[:, None, None], T_b @ chain.relative(b, everything), at)
        return co.from_matrices(se3.orthonormalise(at)[chain.rank], self.trusted.dimension)


def condense(data: GraphData, loops: Edges, odometry: Edges, chain: GraphOdometry) -> Condensed:
    """Return the condensed graph.

    Args:
        data: the graph without loops, whose odometry reaches every pose.
        loops, odometry: edges of the whole graph.
        chain: poses and covariances along the odometry.
    """
    keep = _kept(data, loops, odometry, chain)
    kept = np.flatnonzero(keep)
    new = np.full(len(data), -1, dtype=np.int64)
    new[kept] = np.arange(len(kept))
    small = GraphData(data.dimension)
    keys = data.keys_at(kept.tolist())
    small.add_poses(keys, data.initial_values[kept])
    for key in data.fixed:
        small.fix(key)
    small.landmarks, small.calibrations = data.landmarks.copy(), data.calibrations
    small.origin, small.other_factors = data.origin, dict(data.other_factors)
    steps = _stretches(chain, keep, odometry)
    d = data.tangent_size
    small.edges.extend(
        np.arange(len(steps.i)), np.column_stack([new[steps.i], new[steps.j]]),
        co.from_matrices(steps.T, data.dimension), steps.information, np.full(len(steps.i), FORMS.index("information")),
    )  # fmt: skip
    assert steps.information.shape[1:] == (d, d)
    return Condensed(
        small,
        replace(loops, i=new[loops.i], j=new[loops.j]),
        replace(steps, i=new[steps.i], j=new[steps.j]),
        kept,
        chain,
    )


def _kept(data: GraphData, loops: Edges, odometry: Edges, chain: GraphOdometry) -> Mask:
    """Return which poses ``(N,)`` more than one stretch concerns, or which end one."""
    keep = np.zeros(len(data), dtype=bool)
    keep[np.concatenate([loops.i, loops.j])] = True
    keep[[data.index[key] for factor in data.other_factors.values() for key in factor.keys]] = True
    keep[[data.index[key] for key in data.fixed]] = True
    pairs = np.sort(np.column_stack([chain.rank[odometry.i], chain.rank[odometry.j]]), axis=1)
    distinct, counts = np.unique(pairs, axis=0, return_counts=True)
    by_rank = np.argsort(chain.rank)
    keep[by_rank[distinct[counts > 1].ravel()]] = True  # measured more than once
    ends = np.bincount(distinct.ravel(), minlength=len(data)) == 1
    keep[by_rank[ends]] = True
    keep[by_rank[np.bincount(distinct.ravel(), minlength=len(data)) == 0]] = True
    return keep


def _stretches(chain: GraphOdometry, keep: Mask, odometry: Edges) -> Edges:
    """Return one edge for each stretch of odometry between two poses that are kept, and single steps as they are."""
    single = keep[odometry.i] & keep[odometry.j]
    by_rank = np.argsort(chain.rank)
    ranks = np.flatnonzero(keep[by_rank])
    a, b = ranks[:-1], ranks[1:]
    long = (b - a > 1) & chain.joined(a, b)
    a, b = a[long], b[long]
    covariance = chain.covariance(a, b)
    if odometry.planar:
        covariance = covariance[:, 2:5, 2:5]
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    made = Edges(
        np.full(len(a), -1), by_rank[a], by_rank[b], chain.relative(a, b),
        np.asarray(np.linalg.inv(covariance), dtype=np.float64), np.ones(len(a), dtype=bool),
    )  # fmt: skip
    kept = odometry.where(single)
    both = [(getattr(kept, name), getattr(made, name)) for name in ("ids", "i", "j", "T", "information", "consecutive")]
    return Edges(*(np.concatenate(pair) for pair in both))
