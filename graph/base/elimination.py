"""Orders in which to eliminate poses, by GTSAM, for linear systems that SuperLU solves."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core.arrays import Index, Mask

# Poses from which nested dissection (METIS) orders the unknowns: minimum degree (COLAMD) is five times quicker, 2 ms at
# 3,500 poses, but its elimination tree is as deep as chains are long, and SuperLU overflows the main thread's stack on
# that of 200,000 poses. SuperLU's own ordering of the rotations of 50,000 poses takes 14 s, these two 0.04 and 0.2 s.
_LARGE = 20_000


def elimination_order(known: Mask, i: Index, j: Index) -> Index:
    """Return the unknown poses in an order in which elimination fills the linear system little.

    Args:
        known: ``(N,)`` which poses are no unknowns.
        i, j: indices ``(M,)`` of the poses that each edge joins.
    """
    graph = gtsam.SymbolicFactorGraph()
    add = graph.push_factor
    inside = ~(known[i] | known[j])
    for k in np.flatnonzero(~known).tolist():
        add(k)
    for a, b in zip(i[inside].tolist(), j[inside].tolist(), strict=True):
        add(a, b)
    make = gtsam.Ordering.MetisSymbolicFactorGraph if len(known) > _LARGE else gtsam.Ordering.ColamdSymbolicFactorGraph
    ordering = make(graph)
    return np.fromiter(map(ordering.at, range(ordering.size())), np.int64)
