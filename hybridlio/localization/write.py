"""Write a localised run as a run folder."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.files import write_atomically
from hybridlio.core.version import __version__
from hybridlio.evaluation.evaluate import Steps
from hybridlio.localization.result import Localization
from hybridlio.runs import folder as run_folder
from hybridlio.runs.whole_folder import replaced_folder
from hybridlio.runs.write import notes


def write_localization(folder: Path, localization: Localization, map_path: Path, crs: str | None = None) -> None:
    """Write poses in the map's frame, covariances, ``localization.csv`` and ``metrics.json``.

    The table has one row a scan: ``frame``, ``stamp_ns``, ``held`` (1 where the map held the pose), ``matched``,
    ``cost`` (empty where the scan was not matched) and ``sigma_m`` of the position.

    Args:
        folder: appears whole, or replaces an earlier run.
        localization: the result.
        map_path: where the map is, for the reader.
        crs: the coordinate reference system that the map states, which maps of the run then state too.

    Raises:
        ConfigError: the folder is being written by another process.
        DataError: a file cannot be written.
    """
    run, trajectory = localization.run, localization.trajectory
    assert trajectory.covariances is not None
    steps = Steps(se3.between(trajectory.poses[:-1], trajectory.poses[1:]), run.steps.covariances)
    with replaced_folder(folder, run_folder.is_own_file) as part:
        run_folder.write_trajectory(part, trajectory, None, steps, run.stamps_before)
        write_atomically(part / run_folder.LOCALIZATION, _table(localization))
        metrics = {
            "hybridlio": __version__,
            "sequence": run.sequence.name,
            "map": str(map_path),
            "frames": len(run.sequence),
            "frames_done": run.done,
            "found": run.skipped + localization.found,
            "held_share": float(localization.held.mean()),
            "bridged": run.bridged,
            "path_length_m": trajectory.length_m,
            "seconds": run.seconds,
            "notes": notes(run),
        }
        if crs is not None:
            metrics["crs"] = crs
        if run.sequence.source is not None:
            metrics["recording"] = run.sequence.source.to_json_dict()
        run_folder.write_metrics(part, metrics)


def _table(localization: Localization) -> str:
    text, trajectory = io.StringIO(), localization.trajectory
    assert trajectory.covariances is not None
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["frame", "stamp_ns", "held", "matched", "cost", "sigma_m"])
    sigmas_m = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2))
    for k, stamp_ns in enumerate(trajectory.stamps_ns.tolist()):
        fit = ["" if np.isnan(value[k]) else f"{value[k]:.4f}" for value in (localization.matched, localization.cost)]
        frame = localization.run.skipped + k
        rows.writerow([frame, stamp_ns, int(localization.held[k]), *fit, f"{sigmas_m[k]:.4f}"])
    return text.getvalue()
