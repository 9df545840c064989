"""Result folders that appear whole: written under a hidden name, then renamed.

``RUNS/NAME`` is written as ``RUNS/.NAME.partial``. When all its files are on the disk it becomes
``RUNS/.NAME.complete`` and then, by one more rename, visible. A folder that is replaced stays until then; afterwards
it is ``RUNS/.NAME.old`` until its files are removed.
``RUNS/.NAME.lock`` names the process that writes. What a killed process leaves is cleaned by the next writer; an
unfinished run with its journal stays, and a result that only lacked its new name gets it.

Some folders cannot be renamed: mount points, the current folder, and those in a folder without write permission. For
them the four names lie inside the folder, and files are moved one by one, ``metrics.json`` last.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import locked, make_folder

COMPLETE_MARKER = "metrics.json"  # written last
JOURNAL, STATE = "journal.bin", "state.bin"  # of a run that is not finished; see hybridlio.runs.unfinished.keeper
IsOwn = Callable[[PurePath], bool]

_NEW = ".new"  # in the new of two folders while they are exchanged
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux: fcntl.h and fs.h
_owners: dict[Path, int] = {}  # the folders that this process holds, and the thread that holds each


def partial_folder(folder: Path) -> Path:
    """Return the hidden folder in which the new content of a folder is written."""
    return _hidden(folder, "partial")


def _hidden(folder: Path, what: str) -> Path:
    folder = folder.resolve()
    return folder / f".{what}" if _is_fixed(folder) else folder.with_name(f".{folder.name}.{what}")


def _is_fixed(folder: Path) -> bool:
    """Return whether a folder cannot be renamed."""
    if not folder.is_dir():
        return False
    return folder == Path.cwd() or os.path.ismount(folder) or not os.access(folder.parent, os.W_OK)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let no other process write the folder during the block. The thread that holds a folder may hold it again.

    The lock of a process that died is taken over.

    Raises:
        ConfigError: another process, or another thread of this one, holds the folder; names the process.
        DataError: the lock cannot be created.
    """
    if is_held(folder):
        yield
        return
    folder = folder.resolve()
    with locked(_hidden(folder, "lock"), wait=False) as holder:
        if holder is not None:
            raise ConfigError(f"{folder} is being written by {holder}; wait for it, or choose another folder")
        _owners[folder] = threading.get_ident()
        try:
            yield
        finally:
            del _owners[folder]


def is_held(folder: Path) -> bool:
    """Return whether this thread holds the folder, and so has checked that it may be written."""
    return _owners.get(folder.resolve()) == threading.get_ident()


@contextmanager
def replaced_folder(folder: Path, is_own: IsOwn, keep_journal: Callable[[], bool] = bool) -> Iterator[Path]:
    """Give a hidden folder to write to, which replaces ``folder`` when the block ends without an error.

    It is empty but for the journal of the run that is written. Files in ``folder`` that are not the program's own are
    kept: they move to the new folder.

    Args:
        folder: the folder to create or replace.
        is_own: returns whether a path, relative to the folder, is a file that the program wrote and may remove.
        keep_journal: returns at the end whether the run is not finished, and its journal stays with the result.

    Raises:
        ConfigError: another process writes the folder.
        DataError: the folder cannot be written.
    """
    with held(folder):
        recover(folder, is_own)
        part, folder = partial_folder(folder), folder.resolve()
        make_folder(part)
        try:
            yield part
            (part / _NEW).touch()
            _synchronise(part)
            complete = _hidden(folder, "complete")
            os.rename(part, complete)
            if not keep_journal():
                discard_journal(complete)
            _publish(complete, folder, is_own)
        except OSError as error:
            if error.filename is None or not Path(error.filename).is_relative_to(folder.parent):
                raise
            raise DataError(f"cannot write {folder}: {error.strerror or error}; choose another folder") from error
        finally:
            recover(folder, is_own)


def recover(folder: Path, is_own: IsOwn) -> None:
    """Clean up what a killed writer of the folder left. The caller holds the folder.

    A result that is complete but for its name gets it. Otherwise a folder that was being replaced comes back.
    """
    old, part, complete = _hidden(folder, "old"), partial_folder(folder), _hidden(folder, "complete")
    folder = folder.resolve()
    if (complete / _NEW).exists():
        _publish(complete, folder, is_own)
    elif old.is_dir() and not folder.exists():
        os.rename(old, folder)
    (folder / _NEW).unlink(missing_ok=True)
    for leftover in (old, part, complete):
        if leftover.is_dir():
            kept = (JOURNAL, STATE) if leftover == part and (part / JOURNAL).is_file() else ()
            _absorb(leftover, folder, is_own, kept)


def discard_journal(folder: Path) -> None:
    """Remove the journal of an unfinished run, the state first: without it nothing is resumed."""
    for name in (STATE, JOURNAL):
        (folder / name).unlink(missing_ok=True)


def _publish(part: Path, folder: Path, is_own: IsOwn) -> None:
    old = _hidden(folder, "old")
    if _is_fixed(folder):
        _move_files(part, folder, is_own)
    elif not folder.exists() or not any(folder.iterdir()):
        os.rename(part, folder)  # an empty folder is replaced
    elif _exchange(part, folder):
        os.rename(part, old)
    else:
        os.rename(folder, old)
        os.rename(part, folder)
    (folder / _NEW).unlink(missing_ok=True)
    _synchronise_one(folder.parent)
    if old.is_dir():
        _absorb(old, folder, is_own)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders in one step; return False where the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        return False
    return bool(rename(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0)


def _move_files(part: Path, folder: Path, is_own: IsOwn) -> None:
    """Move all files into a folder that cannot be renamed; without its marker it is incomplete meanwhile.

    The old marker is removed last: while it is there, no file has been moved, so a killed call can be repeated.
    """
    marker = folder / COMPLETE_MARKER
    if marker.is_file():
        for path in [path for path in folder.rglob("*") if path != marker and part not in path.parents]:
            if path.is_file() and is_own(path.relative_to(folder)):
                path.unlink()
        marker.unlink()
    for path in sorted(part.iterdir(), key=lambda one: one.name == COMPLETE_MARKER):
        os.replace(path, folder / path.name)
    part.rmdir()


def _absorb(leftover: Path, folder: Path, is_own: IsOwn, kept: tuple[str, ...] = ()) -> None:
    """Remove a folder and the program's own files in it but those kept; other files move to the place in ``folder``."""
    for path in sorted(leftover.rglob("*"), reverse=True):  # files before their folders
        if path.is_dir() and not path.is_symlink():
            with suppress(OSError):  # it still holds what could not be moved
                path.rmdir()
        elif path.parent == leftover and path.name in kept:
            continue
        elif path == leftover / _NEW or is_own(path.relative_to(leftover)):
            path.unlink()
        else:
            target = _free_name(folder / path.relative_to(leftover))
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(path, target)
    with suppress(OSError):
        leftover.rmdir()


def _free_name(path: Path) -> Path:
    number = 0
    free = path
    while free.exists() or free.is_symlink():
        number += 1
        free = path.with_name(f"{path.name}.{number}")
    return free


def _synchronise(folder: Path) -> None:
    """Wait until all files of a folder are on the disk."""
    for path in (*folder.rglob("*"), folder):
        if not path.is_symlink():
            _synchronise_one(path)


def _synchronise_one(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # some file systems cannot synchronise folders
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
