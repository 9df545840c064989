"""Pose graphs as g2o text, which g2o, GTSAM, Ceres and SE-Sync read.

``VERTEX_SE3:QUAT id x y z qx qy qz qw`` and ``EDGE_SE3:QUAT from to x y z qx qy qz qw`` with the upper triangle of the
information matrix, **translation first**, as GTSAM writes it. GTSAM's own writer keeps six digits, a centimetre at a
kilometre from the start; here every number reads back as it was.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridlio.estimates import RelativePose
from hybridlio.files import write_whole

Array = NDArray[np.float64]

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]


def write_g2o(
    path: str | os.PathLike[str], poses: Array, edges: Iterable[tuple[int, int, RelativePose]], first: int = 0
) -> None:
    """Write a pose graph.

    Args:
        path: the file.
        poses: ``(N, 4, 4)``, one vertex each.
        edges: from, to, and the relative pose measured between them.
        first: the number of the first vertex; the others follow.

    Raises:
        DataError: the place cannot be written to.
    """
    lines = [f"VERTEX_SE3:QUAT {k} {_pose(pose)}" for k, pose in enumerate(poses, first)]
    lines += [f"EDGE_SE3:QUAT {i} {j} {_pose(edge.pose)} {_information(edge.covariance)}" for i, j, edge in edges]
    write_whole(path, "\n".join(lines) + "\n")


def _pose(pose: Array) -> str:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return _numbers(np.concatenate([pose[:3, 3], quaternion]))


def _information(covariance: Array) -> str:
    information = np.linalg.inv(covariance[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)])
    return _numbers(np.asarray(information[np.triu_indices(6)], dtype=np.float64))


def _numbers(values: Array) -> str:
    return " ".join(map(repr, values.tolist()))
