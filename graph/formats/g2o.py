"""Row formats of pose graphs in text: g2o's, which g2o, GTSAM, Ceres and SE-Sync read, and the older TORO's.

One row per vertex or edge. ``VERTEX_SE3:QUAT id x y z qx qy qz qw``; ``EDGE_SE3:QUAT from to x y z qx qy qz qw`` and
the upper triangle of the information matrix, **translation first**, which is taken to be of a right perturbation in
radians and metres, as GTSAM does. Other writers keep six digits, which is a centimetre at a kilometre from the origin;
here every number is written so that it reads back exactly.
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
from hybridlio.core.files import write_atomically
from hybridlio.graph.model import coordinates as co

RowKind: TypeAlias = Literal["vertex", "landmark", "edge", "prior", "position", "point", "bearing-range"]
Values: TypeAlias = Literal["quaternion", "rpy", "heading", "point"]
NoiseIn: TypeAlias = Literal["information", "sigmas", "variances at 10 m"]
_SIZES = {"quaternion": 7, "rpy": 6, "heading": 3}


@dataclass(frozen=True)
class RowFormat:
    """What follows the tag in a row of text.

    Attributes:
        kind: vertex of a pose or a landmark; edge between poses; prior of a pose or a position; observation of a
            landmark as point or as bearing and range.
        dimension: 2 or 3.
        values: what is written: a pose, by how its rotation is written, or a point.
        ids: number of integers at the start.
        triangle: ``(row, column)`` in the information matrix, translation first, of each number at the end.
        optional_information: whether rows may end before the information matrix, which then is the identity.
        noise: what the numbers at the end are.
        letter: first letter of GTSAM's symbol of a landmark, where the row has only its number.
    """

    kind: RowKind
    dimension: co.Dimension
    values: Values
    ids: int
    triangle: tuple[tuple[int, int], ...] = ()
    optional_information: bool = False
    noise: NoiseIn = "information"
    letter: str = ""

    @property
    def keys(self) -> int:
        """Number of vertices that a row names; a further integer is the id of a sensor's offset."""
        return 2 if self.kind in ("edge", "point", "bearing-range") else 1

    @property
    def head(self) -> int:
        """Number of words after the tag and before the information matrix."""
        return self.ids + _SIZES.get(self.values, self.dimension)

    @property
    def length(self) -> int:
        """Number of words after the tag."""
        return self.head + len(self.triangle)


def _upper_triangle(size: int) -> tuple[tuple[int, int], ...]:
    return tuple((i, j) for i in range(size) for j in range(i, size))


_TORO_PLANAR = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))

ROW_FORMATS = {
    "VERTEX_SE3:QUAT": RowFormat("vertex", 3, "quaternion", 1),
    "EDGE_SE3:QUAT": RowFormat("edge", 3, "quaternion", 2, _upper_triangle(6)),
    "EDGE_SE3_PRIOR": RowFormat("prior", 3, "quaternion", 2, _upper_triangle(6)),  # the second id is of an offset
    "VERTEX_SE2": RowFormat("vertex", 2, "heading", 1),
    "EDGE_SE2": RowFormat("edge", 2, "heading", 2, _upper_triangle(3)),
    "EDGE_PRIOR_SE2": RowFormat("prior", 2, "heading", 1, _upper_triangle(3)),
    "EDGE_SE3_PRIORXYZ": RowFormat("position", 3, "point", 1, _upper_triangle(3)),
    "VERTEX_TRACKXYZ": RowFormat("landmark", 3, "point", 1),
    "VERTEX_POINTXYZ": RowFormat("landmark", 3, "point", 1),
    "VERTEX_POINT_XYZ": RowFormat("landmark", 3, "point", 1),
    "EDGE_SE3_TRACKXYZ": RowFormat("point", 3, "point", 3, _upper_triangle(3)),  # the third id is of an offset
    "EDGE_SE3_POINT_XYZ": RowFormat("point", 3, "point", 3, _upper_triangle(3)),
    "VERTEX_XY": RowFormat("landmark", 2, "point", 1),
    "VERTEX_POINT_XY": RowFormat("landmark", 2, "point", 1),
    "EDGE_SE2_XY": RowFormat("point", 2, "point", 2, _upper_triangle(2)),
    "EDGE_BEARING_RANGE_SE2_XY": RowFormat("bearing-range", 2, "point", 2, _upper_triangle(2)),
    # GTSAM's rows, whose landmarks have a numbering of their own; see gtsam/slam/dataset.cpp
    "LANDMARK": RowFormat("bearing-range", 2, "point", 2, _upper_triangle(2), noise="variances at 10 m", letter="l"),
    "BR": RowFormat("bearing-range", 2, "point", 2, ((0, 0), (1, 1)), noise="sigmas", letter="l"),
    "VERTEX3": RowFormat("vertex", 3, "rpy", 1),
    "EDGE3": RowFormat("edge", 3, "rpy", 2, _upper_triangle(6), optional_information=True),
    "VERTEX2": RowFormat("vertex", 2, "heading", 1),
    "EDGE2": RowFormat("edge", 2, "heading", 2, _TORO_PLANAR, optional_information=True),
    "VERTEX": RowFormat("vertex", 2, "heading", 1),
    "EDGE": RowFormat("edge", 2, "heading", 2, _TORO_PLANAR),
    "ODOMETRY": RowFormat("edge", 2, "heading", 2, _TORO_PLANAR),
}
# The same tags in files whose writers order the triangle row by row instead of as TORO does.
ROW_BY_ROW = {tag: RowFormat("edge", 2, "heading", 2, _upper_triangle(3)) for tag in ("EDGE2", "EDGE", "ODOMETRY")}

# Rows that are left out and counted: planes, and priors of directions, as hdl_graph_slam and GLIM write them.
LEFT_OUT_TAGS = frozenset(
    {
        *("VERTEX_PLANE", "EDGE_SE3_PLANE", "EDGE_PLANE", "EDGE_PLANE_IDENTITY", "EDGE_PLANE_PARALLEL"),
        *("EDGE_PLANE_PERPENDICULAR", "EDGE_PLANE_PRIOR_NORMAL", "EDGE_PLANE_PRIOR_DISTANCE"),
        *("EDGE_SE3_PRIORVEC", "EDGE_SE3_PRIORQUAT"),
    }
)


def pose_numbers(coordinates: Array, values: Values) -> Array:
    """Return a row's numbers of a pose from its coordinates."""
    if values != "rpy":
        return coordinates
    yaw_pitch_roll = Rotation.from_quat(coordinates[3:]).as_euler("ZYX")
    return np.concatenate([coordinates[:3], yaw_pitch_roll[::-1]])


def information_numbers(information: Array, row_format: RowFormat) -> Array:
    """Return a row's numbers of an information matrix ``(d, d)``, rotation first."""
    ordered = information
    if row_format.values != "point":
        order = co.TEXT_ORDER[row_format.dimension]
        ordered = information[np.ix_(order, order)]
    return np.array([ordered[cell] for cell in row_format.triangle])


def format_numbers(values: Array) -> str:
    """Return the numbers as the shortest text that reads back exactly."""
    return " ".join(map(repr, values.tolist()))


def write_g2o(
    path: str | os.PathLike[str], poses: Array, edges: Iterable[tuple[int, int, RelativePose]], first: int = 0
) -> None:
    """Write poses and relative poses in g2o's format, without a pose graph.

    Args:
        path: the file.
        poses: ``(N, 4, 4)``, one vertex each.
        edges: from, to, and the relative pose measured between them.
        first: number of the first vertex; the others follow.

    Raises:
        DataError: the file cannot be written.
    """
    edge_format = ROW_FORMATS["EDGE_SE3:QUAT"]
    lines = [f"VERTEX_SE3:QUAT {k} {_format_pose(pose)}" for k, pose in enumerate(poses, first)]
    for i, j, edge in edges:
        matrix = np.asarray(np.linalg.inv(edge.covariance), dtype=np.float64)
        information = format_numbers(information_numbers(matrix, edge_format))
        lines.append(f"EDGE_SE3:QUAT {i} {j} {_format_pose(edge.pose)} {information}")
    write_atomically(path, "\n".join(lines) + "\n")


def _format_pose(pose: Array) -> str:
    return format_numbers(co.from_matrices(pose[None], 3)[0])
