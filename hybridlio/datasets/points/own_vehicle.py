"""Points of the vehicle itself: those that stay at one place in the lidar's frame while all others move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Floats
from hybridlio.datasets.notes import Notes

_VOXEL_M = 0.1  # twice the noise of a lidar at such ranges: a point of the vehicle stays in one or two voxels
_NEAR_M = 4.0  # from the lidar to its vehicle's ends, but for trucks
_FAR_M = 12.0  # where the scene is compared: three times as far
_HALF = round(_FAR_M / _VOXEL_M) + 1  # voxels on each side of the lidar, and one for rounding
_SHAPE = (2 * _HALF, 2 * _HALF, 2 * _HALF)
_MIN_SCANS = 4  # a wall that is as near in all of fewer scans is usual
_MIN_SHARE = 0.01  # of the points, worth a note
_MIN_FAR = 100  # farther voxels of a scan: with fewer, as in a small room, nobody can see whether the scene moves
_MAX_STILL = 0.2  # share of the farther voxels that are occupied in all scans: more, and the vehicle stands
_CELL_M = 1.0  # the lowest farther point of each such cell is on the ground, or on something that hides it
_GROUND_M = 0.3  # above and below the plane of the ground: two voxels, and its unevenness
_FITS = 10  # of the plane; what lies farther than _GROUND_M above one does not count in the next


def note_vehicle(clouds: list[Floats], notes: Notes) -> None:
    """Note points near the lidar that occupy the same voxels in all scans of a moving vehicle, and a box around them.

    Args:
        clouds: ``(N, 3)`` returns of scans that are spread over the recording.
        notes: receives the note.
    """
    if len(clouds) < _MIN_SCANS:
        return
    near, far = [], []
    for cloud in _without_ground(clouds):
        across = np.abs(cloud).max(axis=1)
        near.append(_voxels(cloud[across < _NEAR_M]))
        far.append(_voxels(cloud[(across >= _NEAR_M) & (across < _FAR_M)]))
    still, elsewhere = _in_all(near), _in_all(far)
    usual = float(np.median([len(voxels) for voxels in far]))
    if not len(still) or usual < _MIN_FAR or len(elsewhere) > _MAX_STILL * usual:
        return
    corners_at = np.column_stack(np.unravel_index(still, _SHAPE)) - _HALF
    low, high = corners_at.min(axis=0) * _VOXEL_M, (corners_at.max(axis=0) + 1) * _VOXEL_M
    share = float(np.mean([((c >= low) & (c <= high)).all(axis=1).mean() for c in clouds if len(c)]))
    if share >= _MIN_SHARE:
        least, most = ("[" + ", ".join(f"{value:.1f}" for value in corner) + "]" for corner in (low, high))
        notes.add(
            f"{share:.1%} of the points stay at one place near the lidar while the scene moves, as those of the "
            f"vehicle itself; 'vehicle: {{min: {least}, max: {most}}}' in calibration.yaml leaves them out"
        )


def _voxels(points: Floats) -> NDArray[np.int32]:
    """Return the numbers of the voxels that hold points, each once, sorted."""
    x, y, z = (np.floor(points / _VOXEL_M).astype(np.int32) + _HALF).T
    numbers = np.sort((x * _SHAPE[1] + y) * _SHAPE[2] + z)  # of 32 bits: ten times as quick as numpy.unique
    return numbers[np.diff(numbers, prepend=-1) > 0]


def _without_ground(clouds: list[Floats]) -> list[Floats]:
    """Return the clouds without points on the ground: on a plane, each ring of the lidar stays at its place, too.

    The plane is fitted to the lowest of the farther points in each cell, and again without those high above it.
    """
    pooled = np.concatenate(clouds)
    across = np.abs(pooled).max(axis=1)
    farther = pooled[(across >= _NEAR_M) & (across < _FAR_M)]
    cells = (np.floor(farther[:, :2] / _CELL_M) + round(_FAR_M / _CELL_M)).astype(int) @ [1000, 1]
    order = np.lexsort((farther[:, 2], cells))
    lowest = farther[order[np.diff(cells[order], prepend=-1) > 0]].astype(np.float64)
    columns, height = np.column_stack([lowest[:, :2], np.ones(len(lowest))]), lowest[:, 2]
    kept, plane = np.ones(len(lowest), bool), np.zeros(3)
    for _ in range(_FITS):
        plane = np.linalg.lstsq(columns[kept], height[kept], rcond=None)[0]
        kept = height - columns @ plane < _GROUND_M
    return [c[np.abs(c[:, 2] - c[:, :2] @ plane[:2] - plane[2]) >= _GROUND_M] for c in clouds]


def _in_all(scans: list[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Return the numbers of the voxels that are in every scan."""
    voxels, counts = np.unique(np.concatenate(scans), return_counts=True)
    return np.asarray(voxels[counts == len(scans)])
