"""Open a prior map: a run folder, or a file of points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.files import UNREADABLE_NPZ, opened_npz, user_path
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.points.point_files import SUFFIXES, read_columns
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.run_places import RunPlaces
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.runs.folder import KEYFRAMES, RECORD, is_run_folder, read_run
from hybridlio.smoothing.loop_closure import up_of

_LARGEST_M = 1e9  # coordinates of any system of the Earth are below 5e7 m


def open_prior_map(path: str | Path) -> PriorMap:
    """Open a map: a run folder (smoothed or not), or a ``.ply``, ``.pcd``, ``.las``, ``.laz`` or ``.npz`` file.

    A run folder's map consists of its keyframes, which also are the places by which a run is found in it. A file has
    points only; its floors tell which way is up, and views of it its places.

    Raises:
        DataError: there is no run or no readable file of points.
    """
    path = user_path(path)
    if path.is_dir():
        return map_of_run(path)
    return PriorMap.of(_points(path))


def map_of_run(folder: Path) -> PriorMap:
    """Return the map of a run folder.

    Raises:
        DataError: it is no run folder, or lacks the keyframes.
    """
    if not is_run_folder(folder):
        raise DataError(f"{folder}: not a run folder; give one written by `hybridlio odometry`, or a file of points")
    return map_of_record(*read_record(folder))


def read_record(folder: Path) -> tuple[Record, Trajectory]:
    """Return the record of a run folder with its keyframes, and the folder's poses, which may be smoothed.

    Raises:
        DataError: a file is missing or malformed.
    """
    trajectory = read_run(folder).trajectory
    home = folder if (folder / RECORD).is_file() else folder.parent  # a smoothed run lies inside its run
    return replace(Record.load(home / RECORD), keyframes=LoopKeyframes.load(home / KEYFRAMES)), trajectory


def map_of_record(record: Record, trajectory: Trajectory | None = None) -> PriorMap:
    """Return the map of a run from its record; see :meth:`RunPlaces.of`."""
    run = RunPlaces.of(record, trajectory)
    keyframes = run.keyframes
    points = [se3.transform(pose, keyframes.points(k)) for k, pose in enumerate(run.map_places.poses)]
    return PriorMap.of(np.concatenate(points), run.map_places, up_of(record))


def _points(path: Path) -> Array:
    if not path.is_file():
        raise DataError(f"{path}: no such map; give a run folder or a file of points")
    if path.suffix.lower() == ".npz":
        try:
            with np.errstate(all="ignore"), opened_npz(path) as file:
                points = np.asarray(file["points"], np.float64).reshape(-1, 3)
        except UNREADABLE_NPZ as error:
            raise DataError(f"{path}: not a map ({error}); `hybridlio map` writes one") from error
    elif path.suffix.lower() in SUFFIXES:
        points = _columns(path)
    else:
        raise DataError(f"{path}: unknown format; a map is a run folder or a .ply, .pcd, .las, .laz or .npz file")
    points = points[np.isfinite(points).all(axis=1)]
    if np.abs(points).max(initial=0.0) > _LARGEST_M:
        raise DataError(f"{path}: coordinates over {_LARGEST_M:.0e} m; the file is damaged")
    return points


def _columns(path: Path) -> Array:
    try:
        columns = read_columns(path)
        with np.errstate(all="ignore"):  # what is not finite is left out
            return np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
    except KeyError as error:
        raise DataError(f"{path}: no column {error.args[0]}; a map has x, y and z") from error
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
