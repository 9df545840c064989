"""Keeps recordings from being written to: decides whether a folder may take the output of a command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from hybridlio.core.errors import ConfigError
from hybridlio.core.files import user_path
from hybridlio.datasets import folder as plain_folder
from hybridlio.datasets.kitti import odometry
from hybridlio.datasets.published.table import PUBLISHED
from hybridlio.datasets.rosbag.reader import SUFFIXES

# Levels below the output folder that are searched for recordings: KITTI's root/date/drive is 2 deep, its
# dataset/sequences/00 is 3 deep.
_SEARCH_DEPTH = 3
# An MCAP file begins with its magic, the operation and length of the header record, and the length of its profile.
_MCAP, _MCAP_PROFILE = b"\x89MCAP0\r\n", 8 + 1 + 8 + 4
_MAX_FOLDERS = 5000  # keeps the search below about a second, also where somebody writes to a home folder


def check_output(folder: str | os.PathLike[str], *recordings: str | os.PathLike[str], may_hold: bool = False) -> None:
    """Check that writing to a folder cannot damage a recording. It need not exist.

    Args:
        folder: the folder to write to.
        recordings: paths of recordings that must be neither the folder nor below it, whatever their layout.
        may_hold: allow recordings below the folder, for a command that writes recordings itself.

    Raises:
        ConfigError: the folder is a recording, lies inside one, or holds one.
    """
    out = user_path(folder).resolve()
    given = [user_path(path).resolve() for path in recordings]
    without_stamps = [path for path in given if path in plain_folder.find(path).values()]
    inside = next((above for above in (out, *out.parents) if above in without_stamps or is_recording(above)), None)
    if inside is not None:
        raise _refusal(folder, "is" if inside == out else "lies inside", inside)
    if may_hold:
        return
    held = next((path for path in given if path == out or out in path.parents), None) or next(_below(out), None)
    if held is not None:
        raise _refusal(folder, "is" if held == out else "holds", held)


def check_new_file(file: str | os.PathLike[str], overwrite: bool, *recordings: str | os.PathLike[str]) -> None:
    """Check that a command may write a file: it is new or ``overwrite`` is set, and no recording is damaged by it.

    Args:
        file: the file to write.
        overwrite: whether it may replace another file, which must not be a bag.
        recordings: paths of recordings that the file must not lie in, whatever their layout.

    Raises:
        ConfigError: the file exists, is a folder or a bag, or lies inside a recording.
    """
    path = user_path(file)
    if path.is_dir():
        raise ConfigError(f"{os.fspath(file)} is a folder; name a file")
    if (path.exists() or path.is_symlink()) and not overwrite:
        raise ConfigError(f"{os.fspath(file)} exists; choose another file, or give --overwrite")
    if path.exists() and path.suffix in SUFFIXES and not _is_export(path):
        raise _refusal(file, "is", path)
    check_output(path.parent, *recordings, may_hold=True)


def _is_export(path: Path) -> bool:
    """Return whether an MCAP file, by the first record, is no recording of ROS; such are written for viewers."""
    with path.open("rb") as file:
        start = file.read(_MCAP_PROFILE + 4)
    return start.startswith(_MCAP) and start[_MCAP_PROFILE:] not in (b"ros1", b"ros2")


def _refusal(folder: str | os.PathLike[str], how: str, recording: Path) -> ConfigError:
    which = "a recording" if how == "is" else f"the recording {recording}"
    return ConfigError(f"{os.fspath(folder)} {how} {which}; recordings are never written to: choose another folder")


def is_recording(folder: Path) -> bool:
    """Return whether the folder itself is a recording of any layout."""
    if not folder.is_dir():
        return False
    if any(layout.is_recording(folder) for layout in PUBLISHED.values()):
        return True
    if (folder / "velodyne_points").is_dir() or odometry.is_sequence(folder) or plain_folder.is_recording(folder):
        return True
    return (folder / "metadata.yaml").is_file() and any(p.suffix in SUFFIXES for p in folder.iterdir())


def _below(out: Path) -> Iterator[Path]:
    """Yield the recordings below a folder, those of the upper levels first; hidden folders and links are left out."""
    level, visited = [out], 0
    for _ in range(_SEARCH_DEPTH + 1):
        deeper: list[Path] = []
        for path in level:
            visited += 1
            if visited > _MAX_FOLDERS:
                return
            folders, bags = _entries(path)
            yield from bags
            yield from (one for one in folders if is_recording(one))
            deeper += folders
        level = deeper


def _entries(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the folders and the bags directly below a folder; none if it cannot be listed."""
    try:
        with os.scandir(folder) as found:
            entries = sorted((entry for entry in found if not entry.name.startswith(".")), key=lambda e: e.name)
            folders = [Path(entry) for entry in entries if entry.is_dir(follow_symlinks=False)]
    except OSError:
        return [], []
    return folders, [Path(entry) for entry in entries if Path(entry).suffix in SUFFIXES]
