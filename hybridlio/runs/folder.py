"""Run folders: the files of a run, and how to write and read them.

``metrics.json`` is written last: a folder that has it is complete.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import UNREADABLE_NPZ, atomic_path, opened_npz, write_atomically
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory, read_tum, write_kitti, write_tum
from hybridlio.evaluation.ate_rpe import select
from hybridlio.evaluation.evaluate import Steps
from hybridlio.runs.whole_folder import COMPLETE_MARKER, JOURNAL, STATE

POSES, KITTI, COVARIANCES, GRAPH = "poses_tum.txt", "poses_kitti.txt", "covariances.npz", "graph.g2o"
RECORD, CONFIG, METRICS, REFERENCE = "odometry.npz", "config.yaml", COMPLETE_MARKER, "reference_tum.txt"
REPORT, PICTURE, SMOOTHED, KEYFRAMES = "report.html", "trajectory.png", "smoothed", "keyframes.npz"
LOCALIZATION = "localization.csv"
STATES = "states.npz"  # see hybridlio.runs.results.states
FILES = (POSES, KITTI, COVARIANCES, GRAPH, RECORD, KEYFRAMES, STATES, CONFIG, METRICS, REFERENCE, REPORT, PICTURE)
JOB, LOG = "batch_job.json", "run.log"  # of a run by `hybridlio batch`
_OWN = frozenset((*FILES, LOCALIZATION, JOB, LOG, JOURNAL, STATE, f".{STATE}.new"))
_STEMS = "|".join(Path(name).stem for name in sorted(_OWN))
_TEMPORARY = re.compile(rf"\.({_STEMS})\.[0-9a-f]{{12}}\.\w+")  # names of hybridlio.core.files.atomic_path


@dataclass(frozen=True, eq=False)
class StoredRun:
    """A run as read from its folder.

    Attributes:
        path: the folder.
        trajectory: the estimate with covariances, from the first usable scan on.
        stamps_before: ``(K,)`` stamps of the scans before that, which have filled-in rows; often none.
        steps: the relative poses between estimates, or None if the folder has no covariances of them.
        reference: the ground truth that came with the recording, or None.
        metrics: the content of ``metrics.json``.
    """

    path: Path
    trajectory: Trajectory
    stamps_before: NDArray[np.int64]
    steps: Steps | None
    reference: Trajectory | None
    metrics: dict[str, Any]

    @property
    def T_camera_lidar(self) -> NDArray[np.float64] | None:
        """``(4, 4)`` if this recording's KITTI pose files are in the camera frame, else None."""
        T = self.metrics.get("T_camera_lidar")
        return None if T is None else np.array(T, dtype=np.float64)


def is_own_file(path: PurePath) -> bool:
    """Return whether a path, relative to a run folder, is that of a file which the program writes there."""
    head, *rest = path.parts
    if head.startswith(f".{SMOOTHED}."):  # a smoothing that was killed
        return True
    name = rest[0] if head == SMOOTHED and len(rest) == 1 else head if not rest else ""
    return name in _OWN or bool(_TEMPORARY.fullmatch(name))


def write_trajectory(
    folder: Path,
    trajectory: Trajectory,
    T_camera_lidar: ArrayLike | None,
    steps: Steps | None = None,
    stamps_before: NDArray[np.int64] | None = None,
) -> None:
    """Write the poses in the TUM and KITTI formats, and ``covariances.npz``.

    The latter holds ``stamps_ns`` ``(N,)``, ``absolute`` ``(N, 6, 6)``, ``estimated`` ``(N,)`` and, with ``steps``,
    ``relative_poses`` ``(M-1, 4, 4)`` and ``relative`` ``(M-1, 6, 6)`` of the ``M`` estimated poses; rad² and m²,
    rotation first. Scans before the first usable one have a row too, with ``estimated`` False: the first pose, with
    the covariance of an unknown motion.

    Args:
        folder: the run folder.
        trajectory: the estimated poses.
        T_camera_lidar: write the KITTI file in this camera's frame; None writes it in the lidar's.
        steps: relative poses between estimates.
        stamps_before: stamps of the scans before the first usable one.

    Raises:
        DataError: a file cannot be written.
    """
    whole = trajectory if stamps_before is None else _filled_before(trajectory, stamps_before)
    write_tum(folder / POSES, whole)
    write_kitti(folder / KITTI, whole, T_camera_lidar)
    estimated = np.arange(len(whole)) >= len(whole) - len(trajectory)
    arrays: dict[str, Any] = {"stamps_ns": whole.stamps_ns, "absolute": whole.covariances, "estimated": estimated}
    if steps is not None:
        arrays |= {"relative_poses": steps.poses, "relative": steps.covariances}
    with atomic_path(folder / COVARIANCES) as part, part.open("wb") as file:
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
    """Write ``graph.g2o``: poses ``(N, 4, 4)``, numbered from ``first``, and edges by the poses' rows."""
    from hybridlio.graph.formats.g2o import write_g2o

    write_g2o(folder / GRAPH, poses, [(i + first, j + first, edge) for i, j, edge in edges], first)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``, which marks the folder as complete."""
    write_atomically(folder / METRICS, json.dumps(metrics, indent=2, ensure_ascii=False) + "\n")


def is_run_folder(path: Path) -> bool:
    """Return whether ``path`` is a folder with a complete run."""
    return (path / METRICS).is_file() and (path / POSES).is_file()


def read_run(path: Path) -> StoredRun:
    """Read a run folder.

    Raises:
        DataError: there is no complete run, or one of its files is malformed; names the folder.
    """
    if not is_run_folder(path):
        problem = "no such folder" if not path.exists() else f"not a run folder: it has no {METRICS} and {POSES}"
        raise DataError(f"{path}: {problem}; give a folder written by `hybridlio odometry`")
    whole = read_tum(path / POSES)
    reference = read_tum(path / REFERENCE) if (path / REFERENCE).is_file() else None
    try:
        metrics = _metrics(path / METRICS)
        with opened_npz(path / COVARIANCES) as file:
            arrays = {name: file[name] for name in file.files}
        estimated = arrays["estimated"]
        covered = Trajectory(whole.stamps_ns, whole.poses, arrays["absolute"])
        trajectory = select(covered, np.flatnonzero(estimated))
    except UNREADABLE_NPZ as error:
        files = f"{METRICS}, {POSES} or {COVARIANCES}"
        raise DataError(f"{path}: {files} cannot be read ({error}); run the odometry again") from error
    steps = Steps(arrays["relative_poses"], arrays["relative"]) if "relative" in arrays else None
    return StoredRun(path, trajectory, whole.stamps_ns[~estimated], steps, reference, metrics)


def _metrics(path: Path) -> dict[str, Any]:
    metrics = json.loads(path.read_text(encoding="utf-8"))
    missing = {"sequence", "notes"} - set(metrics)
    if not isinstance(metrics, dict) or missing:
        raise ValueError(f"{path.name} lacks {' and '.join(sorted(missing)) or 'an object'}")
    return metrics
