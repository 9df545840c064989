"""Shards of simulated drives. Scans are computed in memory: only the shards touch the disk, 45 MB for a drive."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.shards import FORMAT, Shard
from hybridlio.learned.settings import Recipe
from hybridlio.odometry.registry import preparation_for
from hybridlio.runs.training.training_data import DataOptions, Done, prepare_once
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.recording import simulated_recording
from hybridlio.simulation.training_drives import training_drive

DRIVE_S = 22.0  # that of the drives that the shipped `published` weights learned from; 220 scans
TRAINING_SEED, VALIDATION_SEED = 41000, 45000  # far apart, so that no drive is in both
_VALIDATION_SHARE = 0.05
_VERSION = 1  # of drives and worlds; raise it when the simulator changes what a seed gives


@dataclass(frozen=True)
class _Drive:
    """A drive, the specimen of its lidar, and the folder of its shard."""

    config: SimulationConfig
    lidar: LidarModel
    folder: Path


def simulated_drives(
    count: int, recipe: Recipe, options: DataOptions, progress: Progress | None = None, lidar: str = "hdl-64e"
) -> tuple[list[Shard], list[Shard]]:
    """Return the shards of simulated drives to train and to validate on; simulate those that are missing.

    Args:
        count: number of drives to train on; another twentieth of it validates.
        recipe: see :func:`hybridlio.runs.training.training_data.prepare_shards`.
        options: folder of the shards, and the source of given initial poses.
        progress: called after each scan.
        lidar: of the drives, see :func:`hybridlio.simulation.training_drives.training_drive`.

    Raises:
        ConfigError: the lidar is unknown.
    """
    validating = max(round(_VALIDATION_SHARE * count), 1)
    seeds = [TRAINING_SEED + k for k in range(count)] + [VALIDATION_SEED + k for k in range(validating)]
    planned = [training_drive(seed, DRIVE_S, lidar) for seed in seeds]
    shards = prepare_drives(planned, recipe, options, progress)
    return shards[:count], shards[count:]


def prepare_drives(
    planned: Iterable[tuple[SimulationConfig, LidarModel]],
    recipe: Recipe,
    options: DataOptions,
    progress: Progress | None = None,
) -> list[Shard]:
    """Return the shards of drives in their order; several processes may share the work.

    Raises:
        DataError: the folder of the shards cannot be written.
    """
    drives = [_Drive(*drive, options.cache / drive_name(*drive, recipe, options.initial_pose)) for drive in planned]
    missing = [drive for drive in drives if not (drive.folder / "shard.json").is_file()]
    waiting = []
    for number, drive in enumerate(missing):
        report = partial(_report, progress, drive.config.seed, number, len(missing))
        if not _prepare(drive, recipe, options, report, wait=False):
            waiting.append(drive)  # another process is at it
    for drive in waiting:
        _prepare(drive, recipe, options, lambda _done: None, wait=True)
    return [Shard(drive.folder) for drive in drives]


def drive_name(config: SimulationConfig, lidar: LidarModel, recipe: Recipe, initial_pose: str | None = None) -> str:
    """Return the name of a drive's shard: its seed, and a digest of all that determines it."""
    path = None if config.poses is None else hashlib.sha256(config.poses.read_bytes()).hexdigest()
    settings = {
        "version": [_VERSION, FORMAT],
        "drive": {**config.model_dump(mode="json"), "poses": path},
        "lidar": asdict(lidar),
        "options": asdict(preparation_for(recipe)),
        "network": [recipe.network.imu, recipe.network.velocity, recipe.network.imu_samples, initial_pose],
    }
    return f"simulated-{config.seed}-{hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:10]}"


def _prepare(drive: _Drive, recipe: Recipe, options: DataOptions, report: Done, wait: bool) -> bool:
    """Simulate and prepare a drive unless its shard exists; return False if another process is at it."""
    if (drive.folder / "shard.json").is_file():
        return True
    sequence = _in_memory(simulated_recording(drive.config, drive.lidar))
    return prepare_once(sequence, drive.folder, recipe, options, report, wait)


def _in_memory(sequence: Sequence) -> Sequence:
    """Return the recording with each scan computed once: odometry and preparation both read it."""
    scans: dict[int, Scan] = {}

    def load(k: int) -> Scan:
        if k not in scans:
            scans[k] = sequence.load_scan(k)
        return scans[k]

    return replace(sequence, load_scan=load)


def _report(progress: Progress | None, seed: int, number: int, count: int, done: int) -> None:
    """Report the progress of a drive among those that are missing."""
    scans = int(10 * DRIVE_S)
    if progress is not None:
        progress(f"simulated drive {seed}", number * scans + done, count * scans)
