"""The folder of a new run: which folders may take one, and what marks the newest."""

from __future__ import annotations

import datetime
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import make_folder
from hybridlio.datasets.protection import check_output
from hybridlio.runs.folder import is_own_file
from hybridlio.runs.own_files import RUN, OwnFiles, check_free
from hybridlio.runs.whole_folder import JOURNAL, STATE, discard_journal, held, partial_folder, recover

_log = logging.getLogger(__name__)


@contextmanager
def new_run_folder(
    sequence: str, out: Path | None, overwrite: bool, *recordings: str | os.PathLike[str], resume: bool = False
) -> Iterator[Path]:
    """Hold the folder of a new run during the block. Entered before the run, so that a wrong folder shows early.

    Args:
        sequence: name of the recording. Without ``out`` the folder is ``runs/<sequence>-<date-time>``, with a number
            appended if that exists.
        out: the folder; None for the default.
        overwrite: allow ``out`` to hold a run, which stays until the new one is complete.
        recordings: paths of the recordings that the run reads.
        resume: the run that stopped or was killed in ``out`` goes on; its journal is in the hidden folder then.

    Raises:
        ConfigError: ``out`` touches a recording, holds a run, or one that is not finished, and neither ``overwrite``
            nor ``resume`` is set, holds other files, or is being written by another process; or there is nothing to
            resume.
        DataError: the folder cannot be created.
    """
    wanted = out or Path("runs") / f"{sequence}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    check_output(wanted, *recordings)
    folder = wanted if out is not None else _create_unique(wanted)
    try:
        with held(folder):
            recover(folder, is_own_file)
            if resume:
                _take_up(folder)
            else:
                check_free(folder, overwrite)
                _check_no_journal(folder, overwrite)
                discard_journal(partial_folder(folder))
            yield folder
    finally:
        if out is None:
            with suppress(OSError):  # it holds the run
                folder.rmdir()


def check_run_folder(
    out: Path | None, overwrite: bool, *recordings: str | os.PathLike[str], resume: bool = False
) -> None:
    """Check that :func:`new_run_folder` will take a folder, before a recording is opened; nothing is changed.

    Raises:
        ConfigError: it will not, as far as can be told now.
    """
    if out is None:
        return
    check_output(out, *recordings)
    if not resume:
        check_free(out, overwrite)
        _check_no_journal(out, overwrite)


@contextmanager
def claimed(folder: Path, files: OwnFiles, *recordings: str | os.PathLike[str]) -> Iterator[None]:
    """Hold a folder while a command writes its files there; what a killed process left of them is removed.

    Raises:
        ConfigError: the folder touches a recording, holds files of these names by somebody else, or is being written by
            another process.
        DataError: the folder cannot be created.
    """
    check_output(folder, *recordings)
    files.check(folder)
    make_folder(folder)
    with held(folder):
        files.remove_leftovers(folder)
        yield


def _take_up(folder: Path) -> None:
    """Let the hidden folder hold the journal of the run to be resumed; that of an interrupted run is copied.

    Raises:
        ConfigError: the folder holds no unfinished run.
    """
    part = partial_folder(folder)
    if (part / JOURNAL).is_file():
        return
    if not (folder / JOURNAL).is_file():
        found = "a finished run" if RUN.are_in(folder) else "no unfinished run"
        raise ConfigError(f"{folder} holds {found}, so there is nothing to resume; run it without --resume")
    make_folder(part)
    for name in (STATE, JOURNAL):  # the journal last: without it nothing is resumed
        if (folder / name).is_file():
            shutil.copyfile(folder / name, part / name)


def _check_no_journal(folder: Path, overwrite: bool) -> None:
    """Check that no unfinished run is lost, unless that is wanted."""
    if not overwrite and (partial_folder(folder) / STATE).is_file():
        raise ConfigError(
            f"{folder} holds a run that was killed; give --resume to go on from its estimates, or --overwrite to start "
            "again"
        )


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
