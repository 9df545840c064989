"""Pose graphs as text: g2o's format, which g2o, GTSAM, Ceres and SE-Sync read, and TORO's, which came before it.

One row a vertex or an edge. ``VERTEX_SE3:QUAT id x y z qx qy qz qw``; ``EDGE_SE3:QUAT from to x y z qx qy qz qw`` with
the upper triangle of the information matrix, **translation first**, taken for that of a right perturbation in radians
and metres, as GTSAM takes it. Other writers keep six digits, a centimetre at a kilometre from the start; here every
number reads back as it was.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import write_whole
from hybridlio.graph.model import coordinates as co

What: TypeAlias = Literal["vertex", "edge", "prior"]
Angles: TypeAlias = Literal["quaternion", "rpy", "heading"]


@dataclass(frozen=True)
class Row:
    """What a row of text holds after its tag.

    Attributes:
        what: vertex, edge or prior.
        dimension: 2 or 3.
        angles: how the rotation is written.
        ids: integers at its start.
        triangle: order of the information matrix: ``(row, column)`` of each number, translation first.
    """

    what: What
    dimension: co.Dimension
    angles: Angles
    ids: int
    triangle: tuple[tuple[int, int], ...] = ()

    @property
    def pose_size(self) -> int:
        """How many numbers the pose takes."""
        return {"quaternion": 7, "rpy": 6, "heading": 3}[self.angles]

    @property
    def length(self) -> int:
        """How many words follow the tag."""
        return self.ids + self.pose_size + len(self.triangle)


def _upper(size: int) -> tuple[tuple[int, int], ...]:
    return tuple((i, j) for i in range(size) for j in range(i, size))


_TORO_PLANAR = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))

ROWS = {
    "VERTEX_SE3:QUAT": Row("vertex", 3, "quaternion", 1),
    "EDGE_SE3:QUAT": Row("edge", 3, "quaternion", 2, _upper(6)),
    "EDGE_SE3_PRIOR": Row("prior", 3, "quaternion", 2, _upper(6)),  # its second number is that of an offset
    "VERTEX_SE2": Row("vertex", 2, "heading", 1),
    "EDGE_SE2": Row("edge", 2, "heading", 2, _upper(3)),
    "EDGE_PRIOR_SE2": Row("prior", 2, "heading", 1, _upper(3)),
    "VERTEX3": Row("vertex", 3, "rpy", 1),
    "EDGE3": Row("edge", 3, "rpy", 2, _upper(6)),
    "VERTEX2": Row("vertex", 2, "heading", 1),
    "EDGE2": Row("edge", 2, "heading", 2, _TORO_PLANAR),
    "VERTEX": Row("vertex", 2, "heading", 1),
    "EDGE": Row("edge", 2, "heading", 2, _TORO_PLANAR),
    "ODOMETRY": Row("edge", 2, "heading", 2, _TORO_PLANAR),
}
# the same file with the triangle row by row, as some write it under TORO's tags
BY_ROWS = {tag: Row("edge", 2, "heading", 2, _upper(3)) for tag in ("EDGE2", "EDGE", "ODOMETRY")}

# what pose graphs do not have: landmarks and cameras, and what only places them
OTHER = frozenset(
    {
        *("VERTEX_XY", "VERTEX_TRACKXYZ", "VERTEX_POINTXYZ", "VERTEX_CAM", "LANDMARK", "BR", "EQUIV"),
        *("EDGE_SE2_XY", "EDGE_BEARING_SE2_XY", "EDGE_BEARING_RANGE_SE2_XY", "EDGE_PRIOR_SE2_XY", "EDGE_XY_PRIOR"),
        *("EDGE_SE3_TRACKXYZ", "EDGE_SE3_XYZ", "EDGE_SE3_XYZ_PRIOR", "EDGE_PROJECT_P2MC"),
        *("PARAMS_SE2OFFSET", "PARAMS_CAMERACALIB", "PARAMS_CAMERAPARAMETERS"),
    }
)


def pose_numbers(coordinates: Array, angles: Angles) -> Array:
    """A row's numbers for a pose from its coordinates."""
    if angles != "rpy":
        return coordinates
    angles_rad = Rotation.from_quat(coordinates[3:]).as_euler("ZYX")
    return np.concatenate([coordinates[:3], angles_rad[::-1]])


def information_numbers(information: Array, row: Row) -> Array:
    """A row's numbers for an information matrix, rotation first."""
    order = co.TEXT_ORDER[row.dimension]
    ordered = information[np.ix_(order, order)]
    return np.array([ordered[cell] for cell in row.triangle])


def format_numbers(values: Array) -> str:
    """As short as they read back exactly."""
    return " ".join(map(repr, values.tolist()))


def write_g2o(
    path: str | os.PathLike[str], poses: Array, edges: Iterable[tuple[int, int, RelativePose]], first: int = 0
) -> None:
    """Write a pose graph in space without making one.

    Args:
        path: the file.
        poses: ``(N, 4, 4)``, one vertex each.
        edges: from, to, and the relative pose measured between them.
        first: the number of the first vertex; the others follow.

    Raises:
        DataError: the place cannot be written to.
    """
    row = ROWS["EDGE_SE3:QUAT"]
    lines = [f"VERTEX_SE3:QUAT {k} {_pose(pose)}" for k, pose in enumerate(poses, first)]
    for i, j, edge in edges:
        information = information_numbers(np.asarray(np.linalg.inv(edge.covariance), dtype=np.float64), row)
        lines.append(f"EDGE_SE3:QUAT {i} {j} {_pose(edge.pose)} {format_numbers(information)}")
    write_whole(path, "\n".join(lines) + "\n")


def _pose(pose: Array) -> str:
    return format_numbers(co.from_matrices(pose[None], 3)[0])
