"""The readers by name, and :func:`open_sequence`, which chooses the reader that fits a path."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import user_path
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.datasets import folder
from hybridlio.datasets.calibration_yaml import MAX_RATE_HZ
from hybridlio.datasets.imu_faults import clipped, without_filled_gaps, without_spikes
from hybridlio.datasets.kitti import odometry, raw
from hybridlio.datasets.kitti.vertical_angle import check_angle
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.packets import ouster, velodyne
from hybridlio.datasets.points.scan_folders import without_stamps
from hybridlio.datasets.published.recording import Layout
from hybridlio.datasets.published.table import PUBLISHED
from hybridlio.datasets.rosbag import reader as rosbag
from hybridlio.datasets.rosbag.choices import BagTopics
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.source import Source


@dataclass(frozen=True)
class ReaderOptions:
    """What a reader may be told about a recording; each reader uses what concerns its layout.

    Attributes:
        raw_root: the root of raw drives to join inertial data from.
        vertical_angle_deg: angle by which points are raised; None to decide by the recording.
        topics: topics and frames of a bag.
        rate_hz: scans per second of a plain folder without stamps.
    """

    raw_root: Path | None = None
    vertical_angle_deg: float | None = None
    topics: BagTopics = field(default_factory=BagTopics)
    rate_hz: float | None = None


@dataclass(frozen=True)
class Reader:
    """Finds and opens recordings of one layout.

    Attributes:
        layout: description of the layout, for messages.
        find: returns the recordings at or directly below a path, by name; empty if the layout does not match.
        open: opens one of them.
        suffixes: of files that are recordings by themselves; such files are given to :attr:`find` as folders are.
    """

    layout: str
    find: Callable[[Path], dict[str, Path]]
    open: Callable[[Path, ReaderOptions], Sequence]
    suffixes: tuple[str, ...] = ()


def _published(layout: Layout) -> Reader:
    return Reader(layout.text, layout.find, lambda path, options: layout.open(path, options.vertical_angle_deg))


READERS: dict[str, Reader] = {  # tried in this order, layouts that are special before those that are general
    **{name: _published(layout) for name, layout in PUBLISHED.items()},
    "kitti-raw": Reader(raw.LAYOUT, raw.find, lambda p, o: raw.open_drive(p, o.raw_root, o.vertical_angle_deg)),
    "kitti-odometry": Reader(
        odometry.LAYOUT,
        odometry.find,
        lambda p, o: odometry.open_sequence_folder(p, o.raw_root, o.vertical_angle_deg),
    ),
    "folder": Reader(
        folder.LAYOUT, folder.find, lambda p, o: folder.open_folder(p, o.raw_root, o.vertical_angle_deg, o.rate_hz)
    ),
    "ouster": Reader(
        ouster.LAYOUT, ouster.find, lambda p, o: ouster.open_recording(p, o.vertical_angle_deg), ouster.SUFFIXES
    ),
    "velodyne": Reader(
        velodyne.LAYOUT, velodyne.find, lambda p, o: velodyne.open_capture(p, o.vertical_angle_deg), velodyne.SUFFIXES
    ),
    "rosbag": Reader(
        rosbag.LAYOUT,
        rosbag.find,
        lambda p, o: rosbag.open_bag(p, o.topics, o.vertical_angle_deg),
        rosbag.SUFFIXES,
    ),
}


def open_sequence(
    path: str | os.PathLike[str],
    *,
    sequence: str | None = None,
    reader: str | None = None,
    raw_root: str | os.PathLike[str] | None = None,
    vertical_angle_deg: float | None = None,
    topics: BagTopics | None = None,
    rate_hz: float | None = None,
) -> Sequence:
    """Open the recording at ``path``.

    Args:
        path: a recording's folder or bag, or a folder that holds recordings.
        sequence: which of several recordings: its name, or its number alone (``0005``, ``09``).
        reader: a name of :data:`READERS`; by default the first whose layout matches.
        raw_root: for KITTI odometry, the folder that holds the raw data's date folders, to join inertial data from.
        vertical_angle_deg: angle by which each point's elevation is raised, to correct an error of the lidar's vertical
            angles. By default 0.205 for KITTI's own scans, which have this error, and 0 for all others.
        topics: for bags, topics and frames to use; by default chosen by type.
        rate_hz: for plain folders without a file of stamps, the scans per second.

    Raises:
        DataError: no such path, no reader fits (the message lists those tried), several recordings without a
            ``sequence`` that selects one, or a recording that the reader cannot open.
        ConfigError: unknown ``reader``, ``vertical_angle_deg`` is over 5°, or ``rate_hz`` is not above 0.
    """
    if rate_hz is not None and not 0 < rate_hz <= MAX_RATE_HZ:
        raise ConfigError(f"rate_hz: must be above 0 and up to {MAX_RATE_HZ:g} scans per second, got {rate_hz:g}")
    root = user_path(path).resolve()
    name, found = _find(root, reader)
    chosen = _pick(root, found, sequence)
    raw = user_path(raw_root).resolve() if raw_root is not None else None
    options = ReaderOptions(raw, vertical_angle_deg, topics or BagTopics(), rate_hz)
    opened = without_false_samples(READERS[name].open(found[chosen], options))
    raw_name = None if raw is None else str(raw)
    source = Source(str(root), chosen, name, raw_name, vertical_angle_deg, options.topics, rate_hz)
    return replace(opened, source=source)


def reopen(source: Source, path: str | os.PathLike[str] | None = None) -> Sequence:
    """Open a recording again as it was opened before.

    Args:
        source: of the recording.
        path: where it is now, if it has moved.

    Raises:
        ConfigError, DataError: as :func:`open_sequence`.
    """
    whole = open_sequence(
        source.path if path is None else path,
        sequence=source.sequence,
        reader=source.reader,
        raw_root=source.raw_root,
        vertical_angle_deg=source.vertical_angle_deg,
        topics=source.topics,
        rate_hz=source.rate_hz,
    )
    used = whole if not source.start and source.stop is None else whole.part(source.start, source.stop)
    return used.every(source.step)


def without_false_samples(sequence: Sequence) -> Sequence:
    """Return the sequence without IMU samples that were not measured, as all readers do; note them and clipped ones.

    Such are spikes, and stretches on a straight line: a recorder filled a gap, or a driver repeated its last sample.
    """
    measured, left_out_ns = without_spikes(sequence.imu)
    imu, gaps = without_filled_gaps(measured)
    notes, first_ns = Notes(sequence.name, list(sequence.notes)), int(sequence.stamps_ns[0])
    if len(left_out_ns):
        notes.corrected(
            f"dropped {counted(len(left_out_ns), 'IMU sample')} far from the neighbouring ones, the first "
            f"{(left_out_ns[0] - first_ns) / NS_PER_S:.2f} s after the first scan"
        )
    if gaps:
        lost_s = sum(end - start for start, end in gaps) / NS_PER_S
        notes.corrected(
            f"dropped the IMU samples of {counted(len(gaps), 'gap')}, {lost_s:.2f} s in all, that a straight line or a "
            f"repeated sample fills, the first {(gaps[0][0] - first_ns) / NS_PER_S:.2f} s after the first scan"
        )
    for what, values, unit in (("angular rates", imu.gyro_rad_s, "rad/s"), ("accelerations", imu.accel_m_s2, "m/s²")):
        for limit, count in clipped(values):
            notes.add(
                f"the IMU's {what} are clipped at {limit:.4g} {unit} in {counted(count, 'sample')}: the motion was "
                "beyond its range there, and is underestimated; record with a larger range"
            )
    return replace(sequence, imu=imu, notes=tuple(notes.texts)) if len(notes.texts) > len(sequence.notes) else sequence


def locate(path: str | os.PathLike[str], sequence: str | None = None, reader: str | None = None) -> tuple[str, Path]:
    """Return the reader's name and the path of the recording that :func:`open_sequence` opens with these arguments.

    Raises:
        DataError: no such path, no reader fits, or several recordings without a ``sequence`` that selects one.
        ConfigError: unknown ``reader``.
    """
    root = Path(path).expanduser().resolve()
    name, found = _find(root, reader)
    return name, found[_pick(root, found, sequence)]


def sequence_names(path: str | os.PathLike[str], *, reader: str | None = None) -> tuple[str, ...]:
    """Return the names of the recordings at or directly below ``path``, as :func:`open_sequence` takes them.

    Raises:
        DataError: no such path, or no reader fits.
        ConfigError: unknown ``reader``.
    """
    return tuple(_find(user_path(path).resolve(), reader)[1])


def check_options(
    reader: str | None = None,
    raw_root: str | os.PathLike[str] | None = None,
    vertical_angle_deg: float | None = None,
) -> None:
    """Check options for many recordings before any of them is opened.

    Raises:
        ConfigError: unknown ``reader``, ``raw_root`` is not a folder, or ``vertical_angle_deg`` is over 5°.
    """
    if vertical_angle_deg is not None:
        check_angle(vertical_angle_deg)
    if reader is not None and reader not in READERS:
        raise ConfigError(f"unknown reader {reader!r}; choose one of {', '.join(READERS)}")
    if raw_root is not None and not user_path(raw_root).is_dir():
        raise ConfigError(f"raw root {raw_root}: no such folder; give the folder that holds KITTI's date folders")


def _find(root: Path, reader: str | None) -> tuple[str, dict[str, Path]]:
    """Return the name of the first reader that finds recordings at ``root``, and the recordings."""
    check_options(reader)
    tried = [reader] if reader else list(READERS)
    if root.is_file():
        tried = [name for name in tried if root.suffix in READERS[name].suffixes]
    if not tried:
        known = ", ".join(dict.fromkeys(suffix for one in READERS.values() for suffix in one.suffixes))
        raise DataError(f"{root}: not a folder; give a recording's folder, or a bag or capture ({known})")
    for name in tried:
        found = READERS[name].find(root)
        if found:
            return name, found
    if not root.exists():  # a scene of nuScenes is found at a path that does not exist
        raise DataError(f"{root}: no such folder or bag; give a recording's folder, or a bag")
    if "folder" in tried and (lacking := without_stamps(root)):
        raise DataError(f"{root}: {lacking}")
    wanted = "\n".join(f"  {name}: {READERS[name].layout}" for name in tried)
    raise DataError(f"{root}: no recording found. Layouts tried:\n{wanted}")


def _pick(root: Path, found: dict[str, Path], sequence: str | None) -> str:
    """Return the name in ``found`` that ``sequence`` selects."""
    wanted = sequence.removesuffix("_sync") if sequence is not None else None
    matches = [name for name in found if wanted is None or name == wanted]
    if not matches and wanted is not None and wanted.isdigit():
        matches = [name for name in found if (tail := re.search(r"\d+$", name)) and int(tail[0]) == int(wanted)]
    if len(matches) == 1:
        return matches[0]
    what = "several recordings" if matches else f"no recording {sequence!r}"
    raise DataError(f"{root}: {what}; choose a sequence: {', '.join(sorted(matches or found))}")
