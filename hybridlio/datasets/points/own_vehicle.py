"""Points of the vehicle itself: bodies that stay at one place in the lidar's frame while the scene moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hybridlio.core.arrays import Array, Floats, Index, Mask
from hybridlio.datasets.notes import Notes

_VOXEL_M = 0.1  # twice the noise of a lidar at such ranges: a point of the vehicle stays in one or two voxels
_NEAR_M = 4.0  # from the lidar to its vehicle's ends, but for trucks
_FAR_M = 12.0  # where the ground is seen: three times as far
_AROUND = 3  # voxels around a body that are looked at: 0.3 m, beyond the scatter of its own points
_HALF = round(_NEAR_M / _VOXEL_M) + _AROUND  # voxels on each side of the lidar
_SHAPE = (2 * _HALF, 2 * _HALF, 2 * _HALF)
_CUBE = np.ones((3, 3, 3), bool)  # a voxel and its neighbours
_MIN_SCANS = 4  # a wall that is as near in all of fewer scans is usual
_MIN_SHARE = 0.01  # of the points, worth a note
# Points around a body, as a share of what a square of as many voxels has around it where its surface goes on at all
# sides. In half a second of walking the scene has 0.08 and more, in a second 0.26; a person who carries the lidar 0.01.
_MAX_AROUND = 0.05
_CELL_RAD = np.radians(2.0)  # of directions in which ranges are compared: several beams
_MIN_CELLS = 100  # with fewer nobody can see whether the scene moves
_MAX_SAME = 0.4  # share of the directions with the same range: 0 to 0.3 after half a second of walking, 0.6 at rest
_CELL_M = 1.0  # the lowest farther point of each such cell is on the ground, or on something that hides it
_GROUND_M = 0.3  # above and below the plane of the ground: two voxels, and its unevenness
_FITS = 10  # of the plane; what lies farther than _GROUND_M above one does not count in the next


def note_vehicle(clouds: list[Floats], notes: Notes) -> None:
    """Note bodies near the lidar that stay at one place in all scans while the scene moves, and a box around them.

    A floor, a wall or a ceiling that slides along itself stays, too, but goes on beyond the part that stays.

    Args:
        clouds: ``(N, 3)`` returns of scans that are spread over the recording.
        notes: receives the note.
    """
    if len(clouds) < _MIN_SCANS:
        return
    above = _AboveGround(clouds)
    bodies = _bodies(above)
    if bodies.any() and not _stands(cloud[~_within(bodies, cloud)] for cloud in above):
        voxels = np.argwhere(bodies) - _HALF
        low, high = voxels.min(axis=0) * _VOXEL_M, (voxels.max(axis=0) + 1) * _VOXEL_M
        share = sum(int(_within(bodies, cloud).sum()) for cloud in above) / sum(map(len, clouds))
        if share >= _MIN_SHARE:
            least, most = ("[" + ", ".join(f"{value:.1f}" for value in corner) + "]" for corner in (low, high))
            notes.add(
                f"{share:.1%} of the points stay at one place near the lidar while the scene moves, as those of the "
                f"vehicle itself; 'vehicle: {{min: {least}, max: {most}}}' in calibration.yaml leaves them out"
            )


def _bodies(clouds: Iterable[Floats]) -> Mask:
    """Return which voxels hold bodies that stay at one place and end there, as a grid around the lidar."""
    numbers = [_numbers(cloud) for cloud in clouds]
    still = np.ones(_SHAPE, bool)
    for occupied in numbers:
        seen = np.zeros(still.size, bool)
        seen[occupied] = True
        still &= seen.reshape(_SHAPE)
    labels = np.empty(_SHAPE, np.int16)  # a body takes 27 voxels and more, so that there are fewer than 2^15
    count = ndimage.label(ndimage.binary_dilation(still, _CUBE), _CUBE, output=labels)
    around = ndimage.maximum_filter(labels, size=2 * _AROUND - 1)
    around[labels > 0] = 0
    own, others = (
        np.median([np.bincount(grid.ravel()[occupied], minlength=count + 1) for occupied in numbers], axis=0)
        for grid in (labels, around)
    )  # what passes close by is there in few scans
    inner = slice(_AROUND, -_AROUND)
    edge = np.ones_like(still)
    edge[inner, inner, inner] = False
    voxels = np.bincount(labels[still], minlength=count + 1)
    sides = 4.0 * (_AROUND - 1) * np.sqrt(voxels)  # voxels around such a square
    ends = others * voxels < _MAX_AROUND * own * sides
    ends[np.unique(labels[edge])] = False  # and 0, which is no body
    ends[0] = False
    return np.asarray(ends[labels])


def _numbers(points: Floats) -> NDArray[np.int32]:
    """Return the numbers of the voxels of the points near the lidar."""
    voxels = _voxels(points)
    near = ((voxels >= 0) & (voxels < 2 * _HALF)).all(axis=1)
    return np.asarray(np.ravel_multi_index(tuple(voxels[near].T), _SHAPE), dtype=np.int32)


def _voxels(points: Floats) -> Index:
    voxels: Index = np.floor(points / _VOXEL_M).astype(np.int64) + _HALF
    return voxels


def _within(bodies: Mask, points: Floats) -> Mask:
    """Return which points are in bodies."""
    x, y, z = np.clip(_voxels(points), 0, 2 * _HALF - 1).T  # the outermost voxels hold no bodies
    return np.asarray(bodies[x, y, z])


def _stands(clouds: Iterable[Floats]) -> bool:
    """Return whether the scene does not move in the lidar's frame, or nobody can see whether it does.

    Ranges tell it and voxels do not: lidars whose pattern does not repeat hit other voxels at rest as well.
    """
    nearest = (_nearest(cloud) for cloud in clouds)
    first = next(nearest)
    for other in nearest:
        seen = np.isfinite(first) & np.isfinite(other)
        same = np.abs(first[seen] - other[seen]) < _VOXEL_M
        if seen.sum() >= _MIN_CELLS and same.mean() < _MAX_SAME:
            return False
    return True


def _nearest(points: Floats) -> Array:
    """Return the range of the nearest point in each cell of directions, infinite without one."""
    xyz = points.astype(np.float64)
    ranges = np.linalg.norm(xyz, axis=1)
    azimuth, elevation = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arcsin(xyz[:, 2] / ranges)
    columns, rows = round(2 * np.pi / _CELL_RAD) + 1, round(np.pi / _CELL_RAD) + 1
    cells = ((elevation + np.pi / 2) / _CELL_RAD).astype(int) * columns + ((azimuth + np.pi) / _CELL_RAD).astype(int)
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, cells, ranges)
    return nearest


def _between(cloud: Floats, least_m: float, most_m: float) -> Floats:
    """Return the points whose largest coordinate is between two bounds."""
    across = np.abs(cloud).max(axis=1)
    return np.asarray(cloud[(across >= least_m) & (across < most_m)])


class _AboveGround:
    """The clouds without points on the ground, made one at a time, as a recording's may be large.

    On a plane each ring of the lidar stays at its place, too. The plane is fitted to the lowest of the farther points
    in each cell, and again without those high above it.
    """

    def __init__(self, clouds: list[Floats]) -> None:
        self._clouds, self._plane = clouds, _ground(clouds)

    def __iter__(self) -> Iterator[Floats]:
        a, b, c = self._plane
        for cloud in self._clouds:
            yield cloud[np.abs(cloud[:, 2] - cloud[:, :2] @ [a, b] - c) >= _GROUND_M]


def _ground(clouds: list[Floats]) -> Array:
    """Return the plane z = a·x + b·y + c as ``(3,)``; zeros without farther points."""
    farther = np.concatenate([_between(cloud, _NEAR_M, _FAR_M) for cloud in clouds])
    cells = (np.floor(farther[:, :2] / _CELL_M) + round(_FAR_M / _CELL_M)).astype(int) @ [1000, 1]
    order = np.lexsort((farther[:, 2], cells))
    lowest = farther[order[np.diff(cells[order], prepend=-1) > 0]].astype(np.float64)
    columns, height = np.column_stack([lowest[:, :2], np.ones(len(lowest))]), lowest[:, 2]
    kept = np.ones(len(lowest), bool)
    plane: Array = np.zeros(3)
    for _ in range(_FITS):
        plane = np.asarray(np.linalg.lstsq(columns[kept], height[kept], rcond=None)[0], dtype=np.float64)
        kept = height - columns @ plane < _GROUND_M
    return plane
