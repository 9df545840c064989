"""Where the scans of a plain folder are, and when each was measured."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points import mesh_vertices, text_rows
from hybridlio.datasets.points.point_files import SUFFIXES
from hybridlio.datasets.stamps import MISSING_STAMP, SCAN_GAP_FACTOR, note_gaps, read_stamps, seconds_ns, usable_scans

SCAN_FOLDERS = ("scans", "lidar", "points", "velodyne", "data", ".")  # the folder itself last: a map may be in it
STAMP_FILES = ("timestamps.txt", "times.txt")
# Files of these kinds are scans only in these folders; `data` is of other sensors, too.
_COMMON_SUFFIXES = (*text_rows.COMMON_SUFFIXES, *mesh_vertices.SUFFIXES)
_OWN_FOLDERS = ("scans", "lidar", "points", "velodyne")

_UNITS_NS = {19: 1, 16: 1000, 13: 1_000_000}  # by the digits of whole numbers that count from 1970
# at the end of a name; seconds since 1970 or in GPS time: fewer digits may be the number of a frame
_NAMED = re.compile(r"(?:.*\D)?(?:(\d{9,10})([._])(\d{1,9})|(\d{19}|\d{16}|\d{13}))")
_MIN_SHARE = 0.5  # of the first lidar's scans: a folder with as many may be another lidar's


@dataclass(frozen=True)
class ScanFiles:
    """The scans of one lidar: files, and their stamps ``(N,)`` in nanoseconds, which increase."""

    paths: tuple[Path, ...]
    stamps_ns: Stamps


def scan_files(folder: Path) -> tuple[Path, ...]:
    """Return the scan files of a recording in natural order.

    They are in the first of :data:`SCAN_FOLDERS` that has any; else, beside a file of stamps, in the only subfolder
    that has any.

    Raises:
        DataError: several subfolders hold scans, and none has one of the usual names.
    """
    for name in SCAN_FOLDERS:
        if found := files_in(folder / name):
            return found
    others = _other_folders(folder) if stamp_files(folder) else []
    if len(others) > 1:
        names = [other.name for other in others]
        raise DataError(
            f"{folder}: scans in {', '.join(names)}; name the folder of the first lidar 'scans'. Those of further ones "
            f"are merged by 'lidars: {{{names[-1]}: …}}' in calibration.yaml, their poses in the first one's frame"
        )
    return files_in(others[0]) if others else ()


def has_scans(folder: Path) -> bool:
    """Return whether a folder holds scans where :func:`scan_files` looks for them."""
    return any(files_in(folder / name) for name in SCAN_FOLDERS) or bool(stamp_files(folder) and _other_folders(folder))


def files_in(folder: Path) -> tuple[Path, ...]:
    """Return the scan files directly in a folder, in natural order; text and meshes only in a folder of scans."""
    files = [p for p in folder.glob("*") if not p.name.startswith(".") and p.name.lower() not in STAMP_FILES]
    found = [p for p in files if p.suffix.lower() in SUFFIXES]
    if not found and folder.name in _OWN_FOLDERS:
        found = [p for p in files if p.suffix.lower() in _COMMON_SUFFIXES]
    return tuple(sorted(found, key=_natural))


def stamp_files(folder: Path) -> list[Path]:
    """Return the files of stamps directly in a folder."""
    return [path for name in STAMP_FILES if (path := named_file(folder, name)).is_file()]


def named_file(folder: Path, name: str) -> Path:
    """Return the path of a file of a plain folder; one whose name has other capitals is taken where that is missing."""
    path = folder / name
    if path.is_file():
        return path
    alike = sorted(p for p in path.parent.glob("*") if p.name.lower() == name.rpartition("/")[2] and p.is_file())
    return alike[0] if alike else path


def without_stamps(folder: Path) -> str:
    """Return what a folder lacks whose only subfolder with scans is not found, as there are no stamps; else nothing."""
    others = [] if has_scans(folder) else _other_folders(folder)
    if len(others) != 1:
        return ""
    return (
        f"{others[0].name!r} holds scans, but no {' or '.join(STAMP_FILES)} is beside it or in it; write one, or name "
        "the folder 'scans' and give --rate 10, the scans a second"
    )


def stamped(folder: Path, paths: tuple[Path, ...], rate_hz: float | None, notes: Notes) -> ScanFiles:
    """Return stamps and files of the scans of a recording, without those whose stamps do not increase.

    Stamps are in a file in the recording's folder or beside the scans, or are the names of the scans' files; else
    scans are evenly spaced.

    Raises:
        DataError: there are no stamps, or not one for each scan; the message says what to write.
    """
    if not paths:
        raise DataError(f"{folder}: no scans ({', '.join(SUFFIXES)})")
    suffixes = sorted({p.suffix.lower() for p in paths})
    if len(suffixes) > 1:
        raise DataError(f"{paths[0].parent}: scans of several kinds ({', '.join(suffixes)}); keep one kind per folder")
    files = [*stamp_files(folder), *stamp_files(paths[0].parent)]
    if files:
        stamps, source = read_stamps(files[0]), files[0]
    elif rate_hz is not None:
        notes.add(f"no {' or '.join(STAMP_FILES)}: scans are taken to be evenly spaced, {rate_hz:g} a second, from 0 s")
        return ScanFiles(paths, np.round(np.arange(len(paths)) * (NS_PER_S / rate_hz)).astype(np.int64))
    elif (named := _named_stamps(paths)) is not None:
        notes.found("stamps are the names of the scans' files")
        order = np.argsort(named, kind="stable")  # fractions of seconds may be of different lengths
        stamps, source, paths = named[order], paths[0].parent, tuple(paths[k] for k in order)
    else:
        raise DataError(
            f"{folder}: no {' or '.join(STAMP_FILES)}; write one stamp per line, in seconds, for each scan, or for "
            "scans at a constant rate give --rate 10 ('rate_hz: 10' in calibration.yaml)"
        )
    if len(stamps) != len(paths) or (stamps == MISSING_STAMP).any():
        raise DataError(f"{source}: {len(stamps)} lines for {len(paths)} scans; each scan needs one stamp")
    return _increasing(paths, stamps, source, notes)


def note_other_folders(folder: Path, used: set[Path], scans: int, notes: Notes) -> None:
    """Note further folders that may hold another lidar's scans, which are not used."""
    unused = [p for p in _other_folders(folder) if p not in used and len(files_in(p)) >= _MIN_SHARE * scans]
    for path in unused:
        notes.add(
            f"scans in {path.name} are not used; if they are another lidar's, 'lidars: {{{path.name}: …}}' in "
            "calibration.yaml merges them, with its pose in the first one's frame"
        )


def _increasing(paths: tuple[Path, ...], stamps: Stamps, source: Path, notes: Notes) -> ScanFiles:
    """Return the scans whose stamps increase."""
    keep = usable_scans(stamps, source)
    if len(keep) < len(paths):
        first = paths[int(np.setdiff1d(np.arange(len(paths)), keep)[0])].name
        notes.corrected(f"dropped {len(paths) - len(keep)} scans whose stamps repeat or go backwards, first {first}")
    note_gaps(stamps[keep], "scans", notes, SCAN_GAP_FACTOR)
    return ScanFiles(tuple(paths[k] for k in keep), stamps[keep])


def _named_stamps(paths: tuple[Path, ...]) -> Stamps | None:
    """Return the stamps that are the names of files; None if a name is no time of this age."""
    stamps = []
    for path in paths:
        if (parts := _NAMED.fullmatch(path.stem)) is None:
            return None
        seconds, mark, fraction, whole = parts.groups()
        if whole:
            stamps.append(int(whole) * _UNITS_NS[len(whole)])
        else:  # behind an underscore there are nanoseconds, which programs write without leading zeros
            stamps.append(seconds_ns(f"{seconds}.{fraction.rjust(9, '0') if mark == '_' else fraction}"))
    return np.array(stamps, np.int64)


def _other_folders(folder: Path) -> list[Path]:
    """Return the subfolders with scans that have none of the usual names and are no recordings of their own."""
    below = sorted(p for p in folder.glob("*") if p.is_dir() and p.name not in SCAN_FOLDERS)
    return [p for p in below if not p.name.startswith(".") and files_in(p)]


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
