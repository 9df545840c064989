"""Gauss-Newton on planar graphs of relative poses and priors, without GTSAM's objects.

GTSAM takes the same steps. Its factors are made one by one from Python, which costs as much as solving: M3500 takes
1.75 times as long as bare GTSAM that way, and 1.02 times in arrays (``benchmarks/pose_graphs.py``).
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.planar.edges import PlanarEdges, wrapped
from hybridlio.graph.planar.system import PlanarSystem

_ORDER = np.array(co.GTSAM_ORDER[2])  # heading, x, y to x, y, heading


class PlanarGaussNewton:
    """Gauss-Newton with the methods of GTSAM's optimiser.

    A prior is an edge from one more pose, at the origin, which is held as fixed poses are.

    Args:
        data: a graph that :func:`solves` accepts.
        start: coordinates ``(N, 3)``.
    """

    def __init__(self, data: GraphData, start: Array) -> None:
        self._edges = planar_edges(data)
        self._system = PlanarSystem(self._edges, held_poses(data))
        self._poses = np.concatenate([start, np.zeros((1, 3))]).T.copy()

    def iterate(self) -> None:
        """Take one step; raise RuntimeError where the system is singular."""
        self._poses = self._poses + self._system.step(self._poses)

    def error(self) -> float:
        """Return half the sum of χ²."""
        return self._edges.error(self._poses)

    def state(self) -> Array:
        """Return coordinates ``(N, 3)``."""
        poses = self._poses[:, :-1].T.copy()
        poses[:, 2] = wrapped(poses[:, 2])
        return poses


def solves(data: GraphData) -> bool:
    """Return whether a graph is planar and has nothing but relative poses and priors, without robust kernels."""
    others = data.other_factors.values()
    plain = all(factor.kind == "prior" and factor.robust is None for factor in others)
    return data.dimension == 2 and plain and not (len(data.landmarks) or data.calibrations or data.edges.robust)


def planar_edges(data: GraphData) -> PlanarEdges:
    """Return the relative poses of a graph, then its priors, as edges from one more pose."""
    priors = list(data.other_factors.values())
    ends = np.array([(len(data), data.index[f.keys[0]]) for f in priors], dtype=np.int64).reshape(-1, 2)
    measured = np.concatenate([data.edges.measured, *(f.measured[None] for f in priors)])
    information = np.concatenate([data.edges.information, *(f.noise.information[None] for f in priors if f.noise)])
    return as_planar(np.concatenate([data.edges.ends, ends]), measured, information)


def as_planar(ends: Index, measured: Array, information: Array) -> PlanarEdges:
    """Return edges from ends ``(M, 2)``, coordinates ``(M, 3)`` and information ``(M, 3, 3)`` of heading, x, y."""
    i, j = ends.T
    in_order = information[:, _ORDER][:, :, _ORDER]
    return PlanarEdges(i.copy(), j.copy(), measured.T.copy(), np.ascontiguousarray(np.moveaxis(in_order, 0, 2)))


def held_poses(data: GraphData) -> Mask:
    """Return which poses ``(N + 1,)`` do not move: fixed ones, and the one more that priors start from."""
    held = np.zeros(len(data) + 1, dtype=bool)
    held[[data.index[key] for key in data.fixed]] = True
    held[-1] = True
    return held
