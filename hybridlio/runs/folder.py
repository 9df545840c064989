"""A run folder: what a run leaves, and how it is found and read again.

``metrics.json`` is written last: a folder that has it is complete.
"""

from __future__ import annotations

import datetime
import json
import logging
import os
from collections.abc import Sequence as Items
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import UNREADABLE_NPZ, write_whole, writing_whole
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.core.trajectory_files import read_tum, write_kitti, write_tum
from hybridlio.evaluation.ate_rpe import select
from hybridlio.evaluation.evaluate import Steps

_log = logging.getLogger(__name__)

POSES, KITTI, COVARIANCES, GRAPH = "poses_tum.txt", "poses_kitti.txt", "covariances.npz", "graph.g2o"
RECORD, CONFIG, METRICS, REFERENCE = "odometry.npz", "config.yaml", "metrics.json", "reference_tum.txt"
REPORT, PICTURE, SMOOTHED, KEYFRAMES = "report.html", "trajectory.png", "smoothed", "keyframes.npz"
FILES = (POSES, KITTI, COVARIANCES, GRAPH, RECORD, KEYFRAMES, CONFIG, METRICS, REFERENCE, REPORT, PICTURE)


@dataclass(frozen=True, eq=False)
class StoredRun:
    """A run as read from its folder.

    Attributes:
        path: the folder.
        trajectory: what was estimated, with covariances; without the rows filled in before the first usable scan.
        stamps_before: ``(K,)`` stamps of those rows, often none.
        steps: the motions between, where the folder has their covariances.
        reference: the truth that came with the recording, at the same rows, or None.
        metrics: what ``metrics.json`` says.
    """

    path: Path
    trajectory: Trajectory
    stamps_before: NDArray[np.int64]
    steps: Steps | None
    reference: Trajectory | None
    metrics: dict[str, Any]

    @property
    def T_camera_lidar(self) -> NDArray[np.float64] | None:
        """``(4, 4)`` where KITTI pose files of this recording are in a camera's frame, else None."""
        T = self.metrics.get("T_camera_lidar")
        return None if T is None else np.array(T, dtype=np.float64)


def new_run_folder(sequence: str, out: Path | None, overwrite: bool) -> Path:
    """The folder to write a run to, made now, so that a place without rights is noticed before the work.

    Without ``out`` it is ``runs/<sequence>-<date-time>``, with a number behind where another run has that already.

    Raises:
        ConfigError: ``out`` holds a run already, or files by the names of a run's, and ``overwrite`` is not set.
        DataError: the folder cannot be made.
    """
    if out is not None and not overwrite:
        _check_free(out)
    wanted = out or Path("runs") / f"{sequence}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    try:
        if out is None:
            return _made_anew(wanted)
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot make the run folder {wanted}: {error.strerror}; choose another with -o") from None
    return out


def _check_free(out: Path) -> None:
    if (out / METRICS).exists():
        raise ConfigError(f"{out} holds a run already; choose another folder, or --overwrite it")
    there = [name for name in (*FILES, SMOOTHED) if (out / name).exists()]
    if there:
        raise ConfigError(
            f"{out} holds {there[0]} and is no finished run; choose another folder, or --overwrite such files"
        )


def _made_anew(wanted: Path) -> Path:
    """The folder, or one with a number behind its name, that was not there and that no other process makes."""
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder
    raise AssertionError("numbers do not end")


def clear(folder: Path) -> None:
    """Remove a run's files and those of its smoothing, what says that it is complete first; leave anything else."""
    for one in (folder, folder / SMOOTHED):
        for name in (METRICS, *FILES):
            (one / name).unlink(missing_ok=True)
    with suppress(OSError):  # not there, or something of somebody else's is in it
        (folder / SMOOTHED).rmdir()


def point_latest_at(folder: Path) -> None:
    """Make ``latest`` beside the folder a link to it, replacing an older one in one move.

    Where that cannot be, as on a disk without links, the log says so: it must not take a finished run's place.
    """
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return
    temporary = folder.parent / f".latest.{os.getpid()}"
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(folder.name)
        temporary.replace(link)
    except OSError as error:
        _log.warning("%s cannot be made a link to %s: %s", link, folder.name, error.strerror or error)


def write_trajectory(
    folder: Path,
    trajectory: Trajectory,
    T_camera_lidar: ArrayLike | None,
    steps: Steps | None = None,
    stamps_before: NDArray[np.int64] | None = None,
) -> None:
    """Write the poses in both text formats, and ``covariances.npz``.

    The latter holds ``stamps_ns`` ``(N,)``, ``absolute`` ``(N, 6, 6)``, ``estimated`` ``(N,)`` and, with ``steps``,
    ``relative_poses`` ``(M-1, 4, 4)`` and ``relative`` ``(M-1, 6, 6)`` of the ``M`` poses that are estimated; rad² and
    m², rotation first. Scans before the first usable one have a row too: the first pose, with the covariance of a
    motion of which nothing is known, and ``estimated`` False.
    """
    whole = trajectory if stamps_before is None else _filled_before(trajectory, stamps_before)
    write_tum(folder / POSES, whole)
    write_kitti(folder / KITTI, whole, T_camera_lidar)
    estimated = np.arange(len(whole)) >= len(whole) - len(trajectory)
    arrays: dict[str, Any] = {"stamps_ns": whole.stamps_ns, "absolute": whole.covariances, "estimated": estimated}
    if steps is not None:
        arrays |= {"relative_poses": steps.poses, "relative": steps.covariances}
    with writing_whole(folder / COVARIANCES) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _filled_before(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Trajectory:
    before_s = (int(trajectory.stamps_ns[0]) - stamps_ns) / NS_PER_S
    covariances = np.array([unknown_motion_covariance(float(dt_s)) for dt_s in before_s]).reshape(-1, 6, 6)
    return Trajectory(
        np.concatenate([stamps_ns, trajectory.stamps_ns]),
        np.concatenate([np.tile(trajectory.poses[0], (len(stamps_ns), 1, 1)), trajectory.poses]),
        None if trajectory.covariances is None else np.concatenate([covariances, trajectory.covariances]),
    )


def write_graph(
    folder: Path, poses: NDArray[np.float64], edges: Items[tuple[int, int, RelativePose]], first: int = 0
) -> None:
    """Write poses, numbered from ``first``, and the relative poses between them (by row) as ``graph.g2o``."""
    from hybridlio.graph.formats.g2o import write_g2o

    write_g2o(folder / GRAPH, poses, [(i + first, j + first, edge) for i, j, edge in edges], first)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``, by which the folder counts as complete."""
    write_whole(folder / METRICS, json.dumps(metrics, indent=2, ensure_ascii=False) + "\n")


def is_run_folder(path: Path) -> bool:
    """Whether there is a run at ``path``."""
    return (path / METRICS).is_file() and (path / POSES).is_file()


def read_run(path: Path) -> StoredRun:
    """Read a run folder.

    Raises:
        DataError: there is no complete run, or one of its files is malformed.
    """
    if not is_run_folder(path):
        what = "no such folder" if not path.exists() else f"no run in it (it has no {METRICS})"
        raise DataError(f"{path}: {what}; `hybridlio odometry` makes run folders")
    whole = read_tum(path / POSES)
    reference = read_tum(path / REFERENCE) if (path / REFERENCE).is_file() else None
    try:
        metrics = _metrics(path / METRICS)
        with np.load(path / COVARIANCES, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        estimated = arrays["estimated"]
        covered = Trajectory(whole.stamps_ns, whole.poses, arrays["absolute"])
        trajectory = select(covered, np.flatnonzero(estimated))
    except UNREADABLE_NPZ as error:
        what = f"its {METRICS}, {POSES} or {COVARIANCES} cannot be read"
        raise DataError(f"{path}: {what} ({error}); run again") from error
    steps = Steps(arrays["relative_poses"], arrays["relative"]) if "relative" in arrays else None
    return StoredRun(path, trajectory, whole.stamps_ns[~estimated], steps, reference, metrics)


def _metrics(path: Path) -> dict[str, Any]:
    metrics = json.loads(path.read_text(encoding="utf-8"))
    missing = {"sequence", "notes"} - set(metrics)
    if not isinstance(metrics, dict) or missing:
        raise ValueError(f"no {' and '.join(sorted(missing)) or 'object'} in {path.name}")
    return metrics
