"""The readers by name, and :func:`open_sequence`, which finds the one that fits a path."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.datasets import folder, kitti_odometry, kitti_raw
from hybridlio.datasets.imu_faults import without_spikes
from hybridlio.datasets.sequence import Notes, Sequence
from hybridlio.datasets.vertical_angle import check_angle


@dataclass(frozen=True)
class Reader:
    """How recordings of one layout are found and opened.

    Attributes:
        layout: what the reader expects, for messages.
        find: the recordings at or just below a path, by name; empty where the layout does not fit.
        open: opens one of them; the second argument is the root of raw drives to join, or None, the third the angle by
            which to raise points in degrees, or None for what the recording needs.
    """

    layout: str
    find: Callable[[Path], dict[str, Path]]
    open: Callable[[Path, Path | None, float | None], Sequence]


READERS: dict[str, Reader] = {  # in the order in which they are tried
    "kitti-raw": Reader(kitti_raw.LAYOUT, kitti_raw.find, kitti_raw.open_drive),
    "kitti-odometry": Reader(kitti_odometry.LAYOUT, kitti_odometry.find, kitti_odometry.open_sequence_folder),
    "folder": Reader(folder.LAYOUT, folder.find, folder.open_folder),
}


def open_sequence(
    path: str | os.PathLike[str],
    *,
    sequence: str | None = None,
    reader: str | None = None,
    raw_root: str | os.PathLike[str] | None = None,
    vertical_angle_deg: float | None = None,
) -> Sequence:
    """Open the recording at ``path``.

    Args:
        path: a recording, or a folder that holds recordings.
        sequence: which one, where there are several: its name, or its number alone (``0005``, ``09``).
        reader: a name of :data:`READERS`; guessed from what lies at ``path`` without it.
        raw_root: for KITTI odometry, the folder of the raw data's date folders, to join inertial data from.
        vertical_angle_deg: raise each point, as seen from the lidar, by this angle against an error of the lidar's
            vertical angles. By default 0.205 for KITTI's own scans, which have it, and 0 for all others.

    Raises:
        DataError: nothing there, no reader fits (lists what was tried), several recordings and no ``sequence`` that
            picks one, or what the reader raises.
        ConfigError: unknown ``reader``, or ``vertical_angle_deg`` is over 5°.
    """
    root = Path(path).expanduser().resolve()
    name, found = _find(root, reader)
    recording = found[_pick(root, found, sequence)]
    raw = Path(raw_root).expanduser() if raw_root is not None else None
    return _without_spikes(READERS[name].open(recording, raw, vertical_angle_deg))


def _without_spikes(sequence: Sequence) -> Sequence:
    """The sequence without inertial samples that nobody measured, which is noted."""
    imu, left_out_ns = without_spikes(sequence.imu)
    if not len(left_out_ns):
        return sequence
    notes = Notes(sequence.name, list(sequence.notes))
    after_s = (left_out_ns[0] - sequence.stamps_ns[0]) / NS_PER_S
    notes.add(
        f"left out {counted(len(left_out_ns), 'inertial sample')} far off those around, the first {after_s:.2f} s "
        "after the first scan"
    )
    return replace(sequence, imu=imu, notes=tuple(notes.texts))


def sequence_names(path: str | os.PathLike[str], *, reader: str | None = None) -> tuple[str, ...]:
    """Names of the recordings at or just below ``path``, each good as ``open_sequence``'s ``sequence``.

    Raises:
        DataError: nothing there, or no reader fits.
        ConfigError: unknown ``reader``.
    """
    return tuple(_find(Path(path).expanduser().resolve(), reader)[1])


def check_options(
    reader: str | None = None,
    raw_root: str | os.PathLike[str] | None = None,
    vertical_angle_deg: float | None = None,
) -> None:
    """Check what is said of many recordings at once, before any of them is opened.

    Raises:
        ConfigError: unknown ``reader``, no folder ``raw_root``, or ``vertical_angle_deg`` is over 5°.
    """
    if vertical_angle_deg is not None:
        check_angle(vertical_angle_deg)
    if reader is not None and reader not in READERS:
        raise ConfigError(f"unknown reader {reader!r}; choose one of {', '.join(READERS)}")
    if raw_root is not None and not Path(raw_root).expanduser().is_dir():
        raise ConfigError(f"raw root {raw_root}: no such folder; give the one that holds KITTI's date folders")


def _find(root: Path, reader: str | None) -> tuple[str, dict[str, Path]]:
    """The first reader that finds recordings at ``root``, and what it finds."""
    check_options(reader)
    if not root.is_dir():
        raise DataError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}; give a recording's folder")
    tried = [reader] if reader else list(READERS)
    for name in tried:
        found = READERS[name].find(root)
        if found:
            return name, found
    wanted = "\n".join(f"  {name}: {READERS[name].layout}" for name in tried)
    raise DataError(f"{root}: no recording found there. Tried\n{wanted}")


def _pick(root: Path, found: dict[str, Path], sequence: str | None) -> str:
    """The name in ``found`` that ``sequence`` means."""
    wanted = sequence.removesuffix("_sync") if sequence is not None else None
    matches = [name for name in found if wanted is None or name == wanted]
    if not matches and wanted is not None and wanted.isdigit():
        matches = [name for name in found if (tail := re.search(r"\d+$", name)) and int(tail[0]) == int(wanted)]
    if len(matches) == 1:
        return matches[0]
    what = "several recordings" if matches else f"no recording {sequence!r}"
    raise DataError(f"{root}: {what}; choose a sequence: {', '.join(sorted(matches or found))}")
