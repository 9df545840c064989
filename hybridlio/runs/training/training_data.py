"""Prepare recordings as shards for training. Each is prepared once, and found again by a digest of its input.

Initial poses and velocities for training come from an odometry run over the recording by scan matching, never from its
reference, which is for validation only. Where scans do not constrain a step, as between smooth walls, the run relies on
the IMU alone and its speed drifts: such a step has no velocity.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Items
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from hybridlio.cloud.deskew import constant_twist, deskew
from hybridlio.cloud.preparation import prepare
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import locked
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import Scan
from hybridlio.datasets.registry import check_options, open_sequence, sequence_names
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.preparing import KnownMotion, prepare_shard
from hybridlio.learned.data.shards import FORMAT, Shard, remove_leftovers
from hybridlio.learned.paper_tables import split as sequences_of
from hybridlio.learned.settings import NetworkSettings, Recipe
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import preparation_for
from hybridlio.runs.run import run_odometry
from hybridlio.runs.training.recipes import LSTM

Done = Callable[[int], None]
"""Called with the number of scans done."""

_VERSION = 2  # of the content of shards; a new version prepares all recordings again
_SCANS_IN_DIGEST = 16  # spread over the recording; hashing all scans would read a long recording twice
_MAX_STEP_SIGMA_M = 0.05  # 0.5 m/s between scans at 10 Hz; a well-constrained step is within a few millimetres


@dataclass(frozen=True)
class DataOptions:
    """How recordings are found and prepared.

    Attributes:
        cache: folder of the shards.
        initial_pose: source of given initial poses. With None, or ``lstm``, which is part of the network, they are by
            preintegration if the recording has an IMU, else by constant velocity.
        sequences: names of the recordings to use from a path that contains several; None for all.
        reader: see ``open_sequence``.
        raw_root: KITTI raw data that provide the IMU of KITTI odometry sequences.
        topics: topics and frames of bags.

    Raises:
        ConfigError: the reader is unknown, or the folder ``raw_root`` does not exist.
    """

    cache: Path
    initial_pose: str | None = None
    sequences: tuple[str, ...] | None = None
    reader: str | None = None
    raw_root: Path | None = None
    topics: BagTopics = NO_CHOICE

    def __post_init__(self) -> None:
        check_options(self.reader, self.raw_root)


def prepare_shards(
    paths: Iterable[Path], recipe: Recipe, options: DataOptions, progress: Progress | None = None
) -> list[Shard]:
    """Return the shards of all recordings at some paths; prepare those that are missing.

    Several processes may call this for the same recordings at once: they share the work, and prepare each one once.

    Args:
        paths: recordings, folders of recordings, shards, or folders of shards.
        recipe: determines the map geometry, the IMU samples, the clouds of the loss, and whether to run the odometry.
        options: where to keep shards, and how to find recordings.
        progress: called after each scan with the recording's name, scans done and scans in all recordings.

    Raises:
        DataError: a path has no recording or shard, or the cache cannot be written; names it.
        ConfigError: the reader or initial pose is unknown.
    """
    found = [item for path in paths for item in _find(Path(path), options)]
    recordings = [item for item in found if isinstance(item, Sequence)]
    total = sum(len(sequence) for sequence in recordings)
    names = [shard_name(sequence, recipe, options.initial_pose) for sequence in recordings]
    folders = [options.cache / name for name in names]
    done, waiting = 0, []
    for sequence, folder in zip(recordings, folders, strict=True):
        report = _report(progress, sequence.name, done, total)
        if not prepare_once(sequence, folder, recipe, options, report, wait=False):
            waiting.append((sequence, folder))  # another process is preparing it
        done += len(sequence)
    for sequence, folder in waiting:
        prepare_once(sequence, folder, recipe, options, _ignore, wait=True)
    prepared = iter(folders)  # in the order of the recordings among what was found
    return [item if isinstance(item, Shard) else Shard(next(prepared)) for item in found]


def training_pairs(
    data: Items[Path],
    validate: Items[Path] | None,
    split: str | None,
    recipe: Recipe,
    options: DataOptions,
    progress: Progress | None = None,
) -> tuple[Pairs, Pairs | None]:
    """Return the pairs to train on, and the pairs to validate on or None.

    Args:
        data: paths to train on.
        validate: paths to validate on; without them, with a split, its test sequences in ``data``.
        split: name of one of the paper's splits of KITTI odometry.
        recipe: see :func:`prepare_shards`.
        options: see :func:`prepare_shards`; its ``sequences`` are those to train on.
        progress: see :func:`prepare_shards`.

    Raises:
        DataError, ConfigError: see :func:`prepare_shards`; or the split is unknown.
    """
    train, tests = split_options(options, split, recipe)
    if split is not None and not validate:
        validate = data
    elif validate:
        tests = replace(options, sequences=None)
    pairs = Pairs(prepare_shards(data, recipe, train, progress), recipe.network)
    return pairs, Pairs(prepare_shards(validate, recipe, tests, progress), recipe.network) if validate else None


def split_options(options: DataOptions, split: str | None, recipe: Recipe) -> tuple[DataOptions, DataOptions]:
    """Return the options to find training and test recordings: by the sequences of the split, if there is one.

    Raises:
        ConfigError: the split is unknown.
    """
    if split is None:
        return options, replace(options, sequences=None)
    train, test = sequences_of(split, recipe.network)
    return replace(options, sequences=options.sequences or train), replace(options, sequences=test)


def needs_odometry(network: NetworkSettings) -> bool:
    """Return whether the network's input includes an initial pose or a velocity, which an odometry run provides."""
    return network.imu == "given" or network.velocity


def shard_name(sequence: Sequence, recipe: Recipe, initial_pose: str | None = None) -> str:
    """Return the recording's name with a digest of its data (of some scans only) and of how it is prepared."""
    settings = {
        "version": [_VERSION, FORMAT],
        "scans": len(sequence),
        "options": asdict(preparation_for(recipe)),
        "imu_samples": recipe.network.imu_samples,
        "initial_pose": _initial_pose_source(sequence, initial_pose) if needs_odometry(recipe.network) else None,
        "imu_noise": None if sequence.imu_noise is None else asdict(sequence.imu_noise),
    }
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    imu = sequence.imu
    arrays = [sequence.stamps_ns, imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2, sequence.calibration.T_imu_lidar]
    arrays += [] if sequence.reference is None else [sequence.reference.stamps_ns, sequence.reference.poses]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    for k in np.unique(np.linspace(0, len(sequence) - 1, _SCANS_IN_DIGEST).astype(np.intp)):
        scan = _load_or_none(sequence, int(k))
        digest.update(b"" if scan is None else np.ascontiguousarray(scan.points).tobytes())
    return f"{sequence.name.replace(os.sep, '-')}-{digest.hexdigest()[:10]}"


def _find(path: Path, options: DataOptions) -> Iterator[Sequence | Shard]:
    shards = [path] if (path / "shard.json").is_file() else sorted(f.parent for f in path.glob("*/shard.json"))
    if shards:
        yield from (Shard(folder) for folder in shards if not folder.name.startswith("."))
        return
    names: Iterable[str] = sequence_names(path, reader=options.reader)
    if options.sequences is not None:
        names = options.sequences
    for name in names:
        yield open_sequence(
            path, sequence=name, reader=options.reader, raw_root=options.raw_root, topics=options.topics
        )


def _report(progress: Progress | None, name: str, before: int, total: int) -> Done:
    """Return the callback of one recording, which reports progress over all recordings."""
    return _ignore if progress is None else lambda done: progress(name, before + done, total)


def _ignore(_done: int) -> None:
    pass


def prepare_once(
    sequence: Sequence, folder: Path, recipe: Recipe, options: DataOptions, report: Done, wait: bool
) -> bool:
    """Prepare the recording unless its shard exists; return False if another process is at it and ``wait`` is False."""
    with locked(folder.with_name(f".{folder.name}.lock"), wait) as holder:
        if holder is None and not (folder / "shard.json").is_file():
            remove_leftovers(folder)
            _prepare(sequence, folder, recipe, options.initial_pose, report)
        return holder is None


def _prepare(sequence: Sequence, folder: Path, recipe: Recipe, initial_pose: str | None, report: Done) -> None:
    source = _initial_pose_source(sequence, initial_pose)
    first = _load_or_none(sequence, 0)
    is_distorted = first is not None and first.time_offsets_ns is not None
    has_odometry = needs_odometry(recipe.network) or is_distorted
    found = _run_odometry(sequence, source, lambda done: report(done // 2)) if has_odometry else _Odometry()
    if is_distorted:
        sequence = replace(sequence, load_scan=partial(_load_deskewed, sequence, found.steps))
    share = 0.5 if has_odometry else 1.0  # of the progress, that is left for preparation
    prepare_shard(
        sequence,
        folder,
        partial(prepare, options=preparation_for(recipe)),
        recipe.network,
        KnownMotion(
            initial=(lambda frame: found.initial.get(frame.index)) if found.initial else None,
            step=(lambda frame: found.reliable_step(frame.index)) if found.steps else None,
            source=f"initial poses by {source}" if found.initial else "",
        ),
        progress=lambda done, total: report(round(total * (1 - share) + done * share)),
    )


@dataclass(frozen=True, eq=False)
class _Odometry:
    """Poses by an odometry run, by the index of the scan that they lead to.

    Attributes:
        initial: well-constrained initial poses ``T_k_k1``.
        steps: steps ``T_k_k1``.
        reliable: the scans that constrain their step well.
    """

    initial: dict[int, Array] = field(default_factory=dict)
    steps: dict[int, Array] = field(default_factory=dict)
    reliable: frozenset[int] = frozenset()

    def reliable_step(self, k: int) -> Array | None:
        return self.steps.get(k) if k in self.reliable else None


def _run_odometry(sequence: Sequence, source: str, report: Done) -> _Odometry:
    config = Config(initial_pose=source, residual="scan-matching")
    run = run_odometry(sequence, Odometry(config=config), lambda _stage, done, _total: report(done))
    if run.stopped is not None:
        raise run.stopped
    initial = {e.index: e.initial.pose for e in run.estimates if e.initial is not None and _is_reliable(e.initial)}
    steps = {e.index: e.step.pose for e in run.estimates if e.step is not None}
    reliable = (
        e.index for e in run.estimates if e.relative is not None and _is_reliable(e.relative, _MAX_STEP_SIGMA_M)
    )
    return _Odometry(initial, steps, frozenset(reliable))


def _is_reliable(pose: RelativePose, max_sigma_m: float = UNKNOWN_TRANSLATION_SIGMA_M) -> bool:
    return pose.ok and pose.translation_sigma_m <= max_sigma_m


def _load_deskewed(sequence: Sequence, steps: dict[int, Array], k: int) -> Scan:
    """Return scan ``k``, motion-compensated by the step that leads to it."""
    scan = sequence.load_scan(k)
    last = k if k in steps else k + 1  # no step leads to the first scan; use the next one
    if last not in steps:
        return scan
    twist = constant_twist(steps[last], int(sequence.stamps_ns[last - 1]), int(sequence.stamps_ns[last]))
    return deskew(scan, twist)


def _initial_pose_source(sequence: Sequence, initial_pose: str | None) -> str:
    if initial_pose is not None and initial_pose != LSTM:
        return initial_pose
    return "preintegration" if len(sequence.imu) else "constant-velocity"


def _load_or_none(sequence: Sequence, k: int) -> Scan | None:
    try:
        return sequence.load_scan(k)
    except DataError:
        return None
