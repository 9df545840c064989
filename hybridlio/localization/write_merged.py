"""Write merged runs: a run folder for each, and how they join."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hybridlio.core import se3
from hybridlio.core.files import write_atomically
from hybridlio.core.trajectory import Trajectory
from hybridlio.core.version import __version__
from hybridlio.evaluation.evaluate import Steps
from hybridlio.record.record import Record
from hybridlio.runs import folder as run_folder
from hybridlio.runs.folder import GRAPH, KEYFRAMES, RECORD, StoredRun
from hybridlio.runs.own_files import MERGE, check_free
from hybridlio.runs.whole_folder import replaced_folder

_KEPT = ("recording", "pose_file_frame", "frames", "frames_done", "bridged", "rejected", "notes")


def names_of(runs: Sequence[Path]) -> list[str]:
    """Return a folder name for each run: its own, numbered where several have the same."""
    names = [run.resolve().name for run in runs]
    return [f"{name}-{n}" if names.count(name) > 1 else name for n, name in enumerate(names, 1)]


class HasMerged(Protocol):
    """What is written of :class:`hybridlio.localization.merge.Merged`."""

    @property
    def trajectories(self) -> tuple[Trajectory | None, ...]:
        """Of each run, in the common world."""
        ...

    @property
    def first_keys(self) -> tuple[int | None, ...]:
        """Of each run in the graph."""
        ...

    def save_graph(self, path: Path) -> None:
        """Write the graph."""
        ...

    def to_json_dict(self) -> dict[str, Any]:
        """Return how the runs join."""
        ...


def write_merged(folder: Path, runs: Sequence[StoredRun], records: Sequence[Record], merged: HasMerged) -> list[str]:
    """Write a run folder for each run that was joined, ``graph.g2o`` and ``merge.json``.

    Poses and covariances of the run folders are in the common world. They hold records and keyframes too, so that each
    can be mapped and localised in; ``merge.json`` has the runs, the joins of each pair, and the runs not joined.

    Args:
        folder: exists, and is held by the caller.
        runs: as read.
        records: theirs, with keyframes.
        merged: the result.

    Returns:
        The names of the run folders.

    Raises:
        ConfigError: a run folder's place is taken.
        DataError: a file cannot be written.
    """
    names = names_of([run.path for run in runs])
    for name, run, record, trajectory in zip(names, runs, records, merged.trajectories, strict=True):
        if trajectory is not None:
            _write_run(folder / name, run, record, trajectory)
    merged.save_graph(folder / GRAPH)
    text = {"hybridlio": __version__, "runs": names, "first_keys": merged.first_keys, **merged.to_json_dict()}
    write_atomically(folder / MERGE.marker, json.dumps(text, indent=2) + "\n")
    return names


def _write_run(folder: Path, run: StoredRun, record: Record, trajectory: Trajectory) -> None:
    check_free(folder, overwrite=True)
    assert record.keyframes is not None
    step_covariances = np.array([step.covariance for step in record.relative])
    steps = Steps(se3.between(trajectory.poses[:-1], trajectory.poses[1:]), step_covariances)
    with replaced_folder(folder, run_folder.is_own_file) as part:
        run_folder.write_trajectory(part, trajectory, None, steps, run.stamps_before)
        record.save(part / RECORD)
        record.keyframes.save(part / KEYFRAMES)
        kept = {name: run.metrics[name] for name in _KEPT if name in run.metrics}
        metrics = {"hybridlio": __version__, "sequence": run.metrics["sequence"], "merged_from": str(run.path)}
        run_folder.write_metrics(part, metrics | kept | {"path_length_m": trajectory.length_m})
