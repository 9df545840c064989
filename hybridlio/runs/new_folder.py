"""The folder of a new run: which folders may take one, and what marks the newest."""

from __future__ import annotations

import datetime
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.protection import check_output
from hybridlio.runs.folder import FILES, JOB, LOG, METRICS, RECORD, SMOOTHED, is_own_file
from hybridlio.runs.own_files import OwnFiles
from hybridlio.runs.whole_folder import held, recover

_log = logging.getLogger(__name__)

RUN = OwnFiles((*FILES, SMOOTHED), METRICS, frozenset({"hybridlio", "sequence"}))
BATCH_JOB = OwnFiles((JOB, LOG), JOB, frozenset({"recording", "settings"}))


@contextmanager
def new_run_folder(
    sequence: str, out: Path | None, overwrite: bool, *recordings: str | os.PathLike[str]
) -> Iterator[Path]:
    """Hold the folder of a new run during the block. Entered before the run, so that a wrong folder shows early.

    Args:
        sequence: name of the recording. Without ``out`` the folder is ``runs/<sequence>-<date-time>``, with a number
            appended if that exists.
        out: the folder; None for the default.
        overwrite: allow ``out`` to hold a run, which stays until the new one is complete.
        recordings: paths of the recordings that the run reads.

    Raises:
        ConfigError: ``out`` touches a recording, holds a run and ``overwrite`` is not set, holds other files, or is
            being written by another process.
        DataError: the folder cannot be created.
    """
    wanted = out or Path("runs") / f"{sequence}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    check_output(wanted, *recordings)
    folder = wanted if out is not None else _create_unique(wanted)
    try:
        with held(folder):
            recover(folder, is_own_file)
            check_free(folder, overwrite)
            yield folder
    finally:
        if out is None:
            with suppress(OSError):  # it holds the run
                folder.rmdir()


def check_free(folder: Path, overwrite: bool) -> None:
    """Check that a run may be written to the folder: it is missing, empty, or holds a run and ``overwrite`` is set.

    A folder with only the log of a run that failed is free, too.

    Raises:
        ConfigError: it may not, or the folder touches a recording.
    """
    check_output(folder)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; choose another name")
    is_run = RUN.are_in(folder)
    if is_run and not overwrite:
        raise ConfigError(f"{folder} already holds a run; choose another folder, or give --overwrite to replace it")
    if not (is_run or BATCH_JOB.are_in(folder) or _is_unused(folder) or (overwrite and _is_half_run(folder))):
        raise ConfigError(f"{folder} holds files but no run of hybridlio, and is left alone; choose another folder")


def _is_unused(folder: Path) -> bool:
    return all(one.name in (".lock", ".partial", ".old") for one in folder.iterdir())


def _is_half_run(folder: Path) -> bool:
    """Return whether the folder holds nothing but files of a run that was killed while it wrote in place."""
    return (folder / RECORD).is_file() and all(is_own_file(p.relative_to(folder)) for p in folder.iterdir())


def _create_unique(wanted: Path) -> Path:
    """Create the folder, or one with a number appended, such that no other process has or gets the same."""
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if folder.is_dir():
                continue
            raise DataError(f"cannot create the run folder {folder}: a file is in its place") from None
        except OSError as error:
            raise DataError(
                f"cannot create the run folder {folder}: {error.strerror}; choose another with -o"
            ) from None
        return folder
    raise AssertionError("unreachable")


def link_latest(folder: Path) -> None:
    """Make ``latest`` beside the folder a link to it; an older link to a folder beside it is replaced in one step.

    Failure, as on a file system without links, is only logged: it must not lose a finished run.
    """
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return
    temporary = folder.parent / f".latest.{os.getpid()}"
    try:
        if link.is_symlink() and link.readlink().parent != Path():  # a link that somebody else made
            return
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(folder.name)
        temporary.replace(link)
    except OSError as error:
        _log.warning("cannot link %s to %s: %s", link, folder.name, error.strerror or error)
