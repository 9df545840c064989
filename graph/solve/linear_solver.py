"""Which linear solver a graph needs, and the parameters and results of GTSAM's optimisers."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.settings import TOLERANCE

# Cholesky squares the condition number, and without a warning loses the far end of a chain: nothing at 1,000 poses, a
# centimetre at 2,000, half a metre at 5,000. QR does not; it costs little on a chain, several times more on a dense
# graph.
_LONGEST_FOR_CHOLESKY = 1000


def levenberg_marquardt_params(use_qr: bool, tolerance: float = TOLERANCE) -> gtsam.LevenbergMarquardtParams:
    """Return the parameters of Levenberg-Marquardt that all solvers here use."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(linear_solver(use_qr))
    params.setRelativeErrorTol(tolerance)
    return params


def needs_qr(data: GraphData) -> bool:
    """Return whether Cholesky would lose precision: long chains far from any fixed or measured pose, or an IMU."""
    if any(factor.kind == "imu" for factor in data.other_factors.values()):
        return True  # biases of 1e-4 and positions of kilometres in one system
    if len(data) <= _LONGEST_FOR_CHOLESKY or not len(data.edges):
        return False
    anchored = {f.keys[0] for f in data.other_factors.values() if f.kind in ("prior", "gps")} | data.fixed
    return _farthest_pose(data, [data.index[key] for key in anchored]) > _LONGEST_FOR_CHOLESKY


def _farthest_pose(data: GraphData, anchored: list[int]) -> int:
    """Return the number of edges between the farthest pose and its nearest anchored one."""
    count = len(data) + len(data.landmarks)  # nodes: poses, then landmarks
    to_anchored = np.column_stack([np.full(len(anchored), count), anchored])  # from one more node, the root
    ends = np.vstack([data.edges.ends, _observation_ends(data), to_anchored])
    adjacency = coo_matrix((np.ones(len(ends), dtype=np.int8), ends.T), shape=(count + 1, count + 1))
    _, parent = breadth_first_order(adjacency.tocsr(), count, directed=False)
    parent[parent < 0] = count
    # depth of every node by pointer doubling: log(depth) passes over arrays instead of a walk per node
    depth, ancestor = (parent != count).astype(np.int64), parent
    while (ancestor != count).any():
        depth, ancestor = depth + depth[ancestor], ancestor[ancestor]
    return int(depth.max())


def _observation_ends(data: GraphData) -> Index:
    """Return ``(M, 2)`` indices of the pose and the landmark of each observation, landmarks counted after poses."""
    observations = (f for f in data.other_factors.values() if f.landmark is not None)
    landmarks = data.landmarks.index
    ends = [(data.index[f.keys[0]], len(data) + landmarks[f.landmark]) for f in observations if f.landmark is not None]
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


def poses_of(values: gtsam.Values, dimension: int) -> Array:
    """Return the coordinates ``(N, 7)`` or ``(N, 3)`` of all poses."""
    if dimension == 2:
        return np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
    rows = np.array(gtsam.utilities.extractPose3(values)).reshape(-1, 12)  # rotation by rows, then position
    return co.from_matrices(se3.make(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]), 3)


def linear_solver(use_qr: bool) -> str:
    """Return GTSAM's name of the linear solver."""
    return "MULTIFRONTAL_QR" if use_qr else "MULTIFRONTAL_CHOLESKY"
