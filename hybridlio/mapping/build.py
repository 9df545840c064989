"""Build a map from the scans of a recording and their poses."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hybridlio.cloud.deskew import deskew
from hybridlio.cloud.normals import estimate_normals
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import DataError
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.mapping.moving_points import RANGE_M, is_moving, vote
from hybridlio.mapping.point_map import PointMap
from hybridlio.mapping.settings import MapSettings
from hybridlio.mapping.sweep_path import sweep_path
from hybridlio.mapping.voxel_tiles import Tile, VoxelGrid, VoxelTiles

_log = logging.getLogger(__name__)

_NORMAL_NEIGHBOURS = 12  # on a surface of one point a voxel, a disc of about two voxels' radius
_SUPPORT_VOXELS = 5.0  # a point with fewer than five others this near has no surface
# Scans compared for moving objects: one in this distance or time, so that a voxel within 40 m is seen by tens of scans;
# all scans of a recording that has no more than a hundred.
_COMPARE_EVERY_M, _COMPARE_EVERY_S, _COMPARE_ALL = 2.0, 1.0, 100
_FAR_M = 10_000.0  # keys of voxels reach 100 km at 0.1 m, single precision keeps a millimetre at 10 km
_ADDING, _COMPARING = "scans added", "scans compared"


class HasScansAndPoses(Protocol):
    """A run, such as ``hybridlio.runs.run.Run``: a recording and the poses estimated for it."""

    @property
    def sequence(self) -> Sequence:
        """The recording."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """Lidar poses ``T_world_lidar``."""
        ...


@dataclass(frozen=True, eq=False)
class MapTiles:
    """The tiles of a map, made one at a time so that a large map never is in memory as a whole.

    Attributes:
        names: column and row of each tile.
        scans: number of scans in the map.
        left_out: number of scans without a pose, or that could not be read.
    """

    names: list[Tile]
    scans: int
    left_out: int
    _tiles: VoxelTiles
    _settings: MapSettings
    _has_intensity: bool
    _shift: Tile = (0, 0)  # of the tiles in memory, which lie near the origin

    @property
    def tile_m(self) -> float:
        """Side of the tiles; tile ``(i, j)`` begins at ``x = i · tile_m``, ``y = j · tile_m``."""
        return self._tiles.grid.tile_m

    def points(self, tile: Tile) -> PointMap:
        """Return the points of a tile, without those of moving objects if the settings say so."""
        voxels = self._tiles.voxels((tile[0] - self._shift[0], tile[1] - self._shift[1]))
        if self._settings.remove_moving:
            voxels = voxels[~is_moving(voxels)]
        at, counts = self._tiles.grid.means(voxels), voxels["points"]
        return PointMap(
            at + self.tile_m * np.array([*self._shift, 0]),
            (voxels["intensity"] / np.maximum(counts, 1)).astype(np.float32) if self._has_intensity else None,
            self._normals(at, voxels["towards"]) if self._settings.normals else None,
            voxels["first_s"].copy(),
            voxels["last_s"].copy(),
            voxels["scans"].copy(),
        )

    def _normals(self, at: Array, towards: Floats) -> Floats:
        """Return normals ``(N, 3)`` of points ``(N, 3)``, turned to the side from which the lidar saw them."""
        if not len(at):
            return np.empty((0, 3), np.float32)
        support_m = _SUPPORT_VOXELS * self._settings.voxel_m
        local = (at - at.mean(axis=0)).astype(np.float32)
        normals = estimate_normals(local, _NORMAL_NEIGHBOURS, thin_m=0.0, support_m=support_m)
        away = np.einsum("ij,ij->i", normals, towards) < 0
        normals[away] *= -1
        return normals


def build_map(
    run: HasScansAndPoses | Sequence,
    trajectory: Trajectory | None = None,
    settings: MapSettings | None = None,
    *,
    skip: Collection[int] = (),
    progress: Progress | None = None,
) -> PointMap:
    """Return the map of a run: its scans, motion compensated, in the world frame, thinned to one point a voxel.

    Args:
        run: a run, or a recording for which ``trajectory`` is given.
        trajectory: lidar poses ``T_world_lidar`` of any odometry, such as smoothed ones, on the recording's clock;
            by default the run's. Poses between them are interpolated.
        settings: range, voxels, and what is removed.
        skip: frames to leave out, such as those whose pose was bridged.
        progress: called after each scan.

    Raises:
        DataError: no scan has a pose.
    """
    with map_tiles(run, trajectory, settings, skip=skip, progress=progress) as tiles:
        return PointMap.joined([tiles.points(tile) for tile in tiles.names])


@contextlib.contextmanager
def map_tiles(
    run: HasScansAndPoses | Sequence,
    trajectory: Trajectory | None = None,
    settings: MapSettings | None = None,
    *,
    skip: Collection[int] = (),
    progress: Progress | None = None,
) -> Iterator[MapTiles]:
    """Build a map as :func:`build_map` does, and give its tiles one by one; those not in use wait on disk.

    Raises:
        DataError: no scan has a pose, or ``trajectory`` is missing.
    """
    settings = settings or MapSettings()
    sequence, poses = _scans_and_poses(run, trajectory)
    grid = VoxelGrid(settings.voxel_m, settings.tile_m)
    shift = _far_tiles(poses, grid.tile_m)
    scans = _PosedScans(sequence, _shifted(poses, shift, grid.tile_m), frozenset(skip), settings)
    voxels = VoxelTiles(grid, settings.max_resident_voxels)
    with contextlib.closing(voxels):
        _add_scans(scans, voxels, progress)
        if settings.remove_moving:
            _compare_scans(scans, voxels, progress)
        names = [(i + shift[0], j + shift[1]) for i, j in voxels.tiles]
        left_out = len(sequence) - scans.used
        yield MapTiles(names, scans.used, left_out, voxels, settings, scans.has_intensity, shift)


def _far_tiles(poses: Trajectory, tile_m: float) -> Tile:
    """Return the tile that a path far from the origin begins in, as in UTM; else that of the origin."""
    first = poses.poses[0, :2, 3]
    if np.abs(first).max() < _FAR_M:
        return 0, 0
    i, j = np.floor(first / tile_m).astype(int).tolist()
    return i, j


def _shifted(poses: Trajectory, tiles: Tile, tile_m: float) -> Trajectory:
    """Return a trajectory moved towards the origin by whole tiles."""
    if tiles == (0, 0):
        return poses
    moved = poses.poses.copy()
    moved[:, :2, 3] -= tile_m * np.array(tiles)
    return Trajectory(poses.stamps_ns, moved, poses.covariances)


def _scans_and_poses(run: HasScansAndPoses | Sequence, trajectory: Trajectory | None) -> tuple[Sequence, Trajectory]:
    if not isinstance(run, Sequence) and not (hasattr(run, "sequence") and hasattr(run, "trajectory")):
        raise DataError(
            f"a map is made of a run or of a recording with its poses, got {type(run).__name__}; `hybridlio map RUN` "
            "takes a run folder, hl.open_sequence(path) opens a recording"
        )
    sequence = run if isinstance(run, Sequence) else run.sequence
    if trajectory is None and isinstance(run, Sequence):
        raise DataError(f"{sequence.name}: give the trajectory of this recording")
    poses = run.trajectory if trajectory is None and not isinstance(run, Sequence) else trajectory
    assert poses is not None
    if len(poses) < 2:
        raise DataError(f"{sequence.name}: a map needs two poses or more, got {len(poses)}")
    return sequence, poses


class _PosedScans:
    """The scans of a recording that have a pose, motion compensated and cut to the range of the map."""

    def __init__(self, sequence: Sequence, poses: Trajectory, skip: frozenset[int], settings: MapSettings) -> None:
        self.sequence, self._settings, self._path = sequence, settings, PosePath(poses.stamps_ns, poses.poses)
        covered = np.flatnonzero(self._path.covers(sequence.stamps_ns))
        self.frames = [int(k) for k in covered if k not in skip]
        if not self.frames:
            raise DataError(
                f"{sequence.name}: no scan has a pose; scans from {sequence.stamps_ns[0]} to {sequence.stamps_ns[-1]} "
                f"ns, poses from {poses.stamps_ns[0]} to {poses.stamps_ns[-1]} ns"
            )
        self.poses = self._path.at(sequence.stamps_ns[self.frames])
        self.used, self.has_intensity = 0, True

    def load(self, row: int) -> Scan | None:
        """Return the scan of a row of ``frames``, motion compensated; None if it cannot be read."""
        frame = self.frames[row]
        try:
            scan = self.sequence[frame].scan
        except DataError as error:
            _log.info("frame %d is left out of the map: %s", frame, error)
            return None
        if scan.time_offsets_ns is not None and len(scan):
            motion = sweep_path(self._path, scan, self.sequence.imu, self.sequence.calibration)
            scan = deskew(scan, motion)
        square = np.einsum("ij,ij->i", scan.points, scan.points)
        kept = (square > self._settings.min_range_m**2) & (square < self._settings.max_range_m**2)
        return scan.part(kept)

    def compared(self) -> list[int]:
        """Return the rows of the scans to compare for moving objects, apart in distance or time."""
        if len(self.frames) <= _COMPARE_ALL:
            return list(range(len(self.frames)))
        rows, last = [0], 0
        stamps = self.sequence.stamps_ns[self.frames]
        for row in range(1, len(self.frames)):
            moved = float(np.linalg.norm(self.poses[row, :3, 3] - self.poses[last, :3, 3]))
            if moved >= _COMPARE_EVERY_M or stamps[row] - stamps[last] >= _COMPARE_EVERY_S * NS_PER_S:
                rows.append(row)
                last = row
        return rows


def _add_scans(scans: _PosedScans, voxels: VoxelTiles, progress: Progress | None) -> None:
    start_ns = int(scans.sequence.stamps_ns[scans.frames[0]])
    for row, pose in enumerate(scans.poses):
        scan = scans.load(row)
        if scan is not None:
            scans.used += 1
            scans.has_intensity &= scan.intensity is not None
            points = scan.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
            time_s = (scan.stamp_ns - start_ns) / NS_PER_S
            voxels.add(voxels.grid.voxels_of(points, pose[:3, 3], scan.intensity, time_s))
        if progress is not None:
            progress(_ADDING, row + 1, len(scans.poses))


def _compare_scans(scans: _PosedScans, voxels: VoxelTiles, progress: Progress | None) -> None:
    rows = scans.compared()
    for done, row in enumerate(rows, 1):
        scan = scans.load(row)
        if scan is not None:
            vote(voxels, scan.points, scans.poses[row], RANGE_M)
        if progress is not None:
            progress(_COMPARING, done, len(rows))
