"""Recordings as shards: each is prepared once, kept, and found again by what it was made from.

What training needs of an initial pose or of the last velocity comes from an odometry run over the recording, by
scan matching: never from its reference, which serves validation alone. Where scans do not tell how far a step went, as
between smooth walls, the run goes on by the IMU alone and its speed soon is anybody's guess: there is no velocity then.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Items
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hybridlio.cloud.deskew import constant_twist, deskew
from hybridlio.cloud.preparation import prepare
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import Scan
from hybridlio.datasets.registry import check_options, open_sequence, sequence_names
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.preparing import prepare_shard
from hybridlio.learned.data.shards import FORMAT, Shard
from hybridlio.learned.presets import split as sequences_of
from hybridlio.learned.settings import NetworkSettings, Recipe
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import preparation_for
from hybridlio.runs.recipes import LSTM
from hybridlio.runs.run import run_odometry

Progress = Callable[[str, int, int], None]

_VERSION = 2  # of what is put into shards; another one prepares recordings anew
_SCANS_IN_DIGEST = 16  # with all, a long recording would be read twice
_UNSURE_STEP_M = 0.05  # a step that scans tell no better gives no velocity


@dataclass(frozen=True)
class DataOptions:
    """How recordings are found and prepared.

    Attributes:
        cache: folder of the shards.
        initial_pose: name of the source of given initial poses; None, or ``lstm``, which is the network's own part,
            takes preintegration where there is an IMU, else constant velocity.
        sequences: which recordings, where a path holds several; None takes all.
        reader: as for ``open_sequence``.
        raw_root: KITTI's raw data, to take the IMU of KITTI odometry sequences from.

    Raises:
        ConfigError: no such reader, or no folder ``raw_root``.
    """

    cache: Path
    initial_pose: str | None = None
    sequences: tuple[str, ...] | None = None
    reader: str | None = None
    raw_root: Path | None = None

    def __post_init__(self) -> None:
        check_options(self.reader, self.raw_root)


def shards_of(
    paths: Iterable[Path], recipe: Recipe, options: DataOptions, progress: Progress | None = None
) -> list[Shard]:
    """Every recording and shard at some paths, prepared for a recipe.

    A path is a recording, a folder of recordings, a shard, or a folder of shards. Several processes may ask for the
    same at once: they share the recordings among them, and each is prepared once.

    Args:
        paths: where to look.
        recipe: decides cells, inertial rows, the loss's clouds, and whether an odometry run is needed.
        options: where to keep shards, and how to find recordings.
        progress: called with a recording's name, scans done and scans in all of all recordings.

    Raises:
        DataError: nothing usable at a path; names it.
        ConfigError: an unknown reader or initial pose.
    """
    found = [item for path in paths for item in _at(Path(path), options)]
    recordings = [item for item in found if isinstance(item, Sequence)]
    total = sum(len(sequence) for sequence in recordings)
    done, folders, waiting = 0, {}, []
    for sequence in recordings:
        show = None if progress is None else partial(progress, sequence.name)
        place = options.cache / shard_name(sequence, recipe, options.initial_pose)
        folders[id(sequence)] = place
        if not _prepared(sequence, place, recipe, options, _shifted(show, done, total), wait=False):
            waiting.append(sequence)  # another process is at it
        done += len(sequence)
    for sequence in waiting:
        _prepared(sequence, folders[id(sequence)], recipe, options, None, wait=True)
    return [item if isinstance(item, Shard) else Shard(folders[id(item)]) for item in found]


def training_pairs(
    data: Items[Path],
    validate: Items[Path] | None,
    split: str | None,
    recipe: Recipe,
    options: DataOptions,
    progress: Progress | None = None,
) -> tuple[Pairs, Pairs | None]:
    """Pairs to train on, and pairs to measure on where there are any to be.

    Args:
        data: what to train on.
        validate: what to measure on; without it, with a split, the split's test sequences of ``data``.
        split: name of one of the paper's splits of KITTI odometry.
        recipe: see :func:`shards_of`.
        options: see :func:`shards_of`; its ``sequences`` are those to train on.
        progress: see :func:`shards_of`.

    Raises:
        DataError, ConfigError: see :func:`shards_of`; or there is no such split.
    """
    train, tests = split_options(options, split, recipe)
    if split is not None and not validate:
        validate = data
    elif validate:
        tests = replace(options, sequences=None)
    pairs = Pairs(shards_of(data, recipe, train, progress), recipe.network)
    return pairs, Pairs(shards_of(validate, recipe, tests, progress), recipe.network) if validate else None


def split_options(options: DataOptions, split: str | None, recipe: Recipe) -> tuple[DataOptions, DataOptions]:
    """Options that find what to train on and what to test on: a split's sequences, or without one, those asked for.

    Raises:
        ConfigError: there is no such split.
    """
    if split is None:
        return options, replace(options, sequences=None)
    train, test = sequences_of(split, recipe.network)
    return replace(options, sequences=options.sequences or train), replace(options, sequences=test)


def needs_odometry(network: NetworkSettings) -> bool:
    """Whether a network is told of an initial pose or of a velocity."""
    return network.imu == "given" or network.velocity


def shard_name(sequence: Sequence, recipe: Recipe, initial_pose: str | None = None) -> str:
    """The recording's name with a digest of what it holds, of its scans only some, and how it is prepared."""
    what = {
        "version": [_VERSION, FORMAT],
        "scans": len(sequence),
        "options": asdict(preparation_for(recipe)),
        "imu_samples": recipe.network.imu_samples,
        "initial_pose": _source(sequence, initial_pose) if needs_odometry(recipe.network) else None,
        "imu_noise": None if sequence.imu_noise is None else asdict(sequence.imu_noise),
    }
    digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode())
    imu = sequence.imu
    arrays = [sequence.stamps_ns, imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2, sequence.calibration.T_imu_lidar]
    arrays += [] if sequence.reference is None else [sequence.reference.stamps_ns, sequence.reference.poses]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    for k in np.unique(np.linspace(0, len(sequence) - 1, _SCANS_IN_DIGEST).astype(np.intp)):
        scan = _readable(sequence, int(k))
        digest.update(b"" if scan is None else np.ascontiguousarray(scan.points).tobytes())
    return f"{sequence.name.replace(os.sep, '-')}-{digest.hexdigest()[:10]}"


def _at(path: Path, options: DataOptions) -> Iterator[Sequence | Shard]:
    shards = [path] if (path / "shard.json").is_file() else sorted(f.parent for f in path.glob("*/shard.json"))
    if shards:
        yield from (Shard(folder) for folder in shards if not folder.name.startswith("."))
        return
    names: Iterable[str] = sequence_names(path, reader=options.reader)
    if options.sequences is not None:
        names = options.sequences
    for name in names:
        yield open_sequence(path, sequence=name, reader=options.reader, raw_root=options.raw_root)


def _shifted(show: Callable[[int, int], None] | None, before: int, total: int) -> Callable[[int], None]:
    return lambda done: None if show is None else show(before + done, total)


def _prepared(
    sequence: Sequence,
    folder: Path,
    recipe: Recipe,
    options: DataOptions,
    show: Callable[[int], None] | None,
    wait: bool,
) -> bool:
    """Prepare the recording unless it is there; False where another process does it just now and ``wait`` is not."""
    with _locked(folder.with_name(f".{folder.name}.lock"), wait) as mine:
        if not mine:
            return False
        if not (folder / "shard.json").is_file():
            _prepare(sequence, folder, recipe, options.initial_pose, show)
        return True


def _prepare(
    sequence: Sequence,
    folder: Path,
    recipe: Recipe,
    initial_pose: str | None,
    show: Callable[[int], None] | None,
) -> None:
    initial: dict[int, Array] = {}
    steps: dict[int, Array] = {}
    sure: set[int] = set()
    source, half = _source(sequence, initial_pose), 1.0
    first = _readable(sequence, 0)
    distorted = first is not None and first.time_offsets_ns is not None
    if needs_odometry(recipe.network) or distorted:
        half = 0.5
        initial, steps, sure = _odometry(sequence, source, lambda done: show(done // 2) if show else None)
    if distorted:
        sequence = replace(sequence, load_scan=partial(_compensated, sequence, steps))
    prepare_shard(
        sequence,
        folder,
        partial(prepare, options=preparation_for(recipe)),
        recipe.network.geometry,
        recipe.network.imu_samples,
        initial=(lambda frame: initial.get(frame.index)) if initial else None,
        step=(lambda frame: steps.get(frame.index) if frame.index in sure else None) if steps else None,
        made_by=f"initial poses by {source}" if initial else "",
        progress=lambda done, total: show(round(total * (1 - half) + done * half)) if show else None,
    )


def _odometry(
    sequence: Sequence, source: str, show: Callable[[int], None]
) -> tuple[dict[int, Array], dict[int, Array], set[int]]:
    """Initial poses and steps ``T_k_k1`` by the number of the scan that they lead to, and which steps scans tell."""
    config = Config(initial_pose=source, residual="scan-matching")
    run = run_odometry(sequence, Odometry(config=config), lambda done, _total, _metres: show(done))
    if run.stopped is not None:
        raise run.stopped
    initial = {e.index: e.initial.pose for e in run.estimates if e.initial is not None and _sure(e.initial)}
    steps = {e.index: e.step.pose for e in run.estimates if e.step is not None}
    sure = {e.index for e in run.estimates if e.relative is not None and _sure(e.relative, _UNSURE_STEP_M)}
    return initial, steps, sure


def _sure(pose: RelativePose, limit_m: float = UNKNOWN_TRANSLATION_SIGMA_M) -> bool:
    return pose.ok and pose.translation_sigma_m <= limit_m


def _compensated(sequence: Sequence, steps: dict[int, Array], k: int) -> Scan:
    scan = sequence.load_scan(k)
    near = k if k in steps else k + 1  # the first scan moves as the second does
    if near not in steps:
        return scan
    twist = constant_twist(steps[near], int(sequence.stamps_ns[near - 1]), int(sequence.stamps_ns[near]))
    return deskew(scan, twist)


def _source(sequence: Sequence, initial_pose: str | None) -> str:
    if initial_pose is not None and initial_pose != LSTM:
        return initial_pose
    return "preintegration" if len(sequence.imu) else "constant-velocity"


def _readable(sequence: Sequence, k: int) -> Scan | None:
    try:
        return sequence.load_scan(k)
    except DataError:
        return None


@contextmanager
def _locked(path: Path, wait: bool) -> Iterator[bool]:
    """Hold a lock among processes; yields whether it is held."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        raise ConfigError(f"{path.parent}: shards cannot be kept there ({error.strerror}); choose --cache") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
