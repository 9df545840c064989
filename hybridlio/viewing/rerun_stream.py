"""Where a Rerun recording goes: a viewer on this machine, or a file."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.core.errors import ConfigError, DataError, MissingDependencyError
from hybridlio.core.files import atomic_path, user_path
from hybridlio.viewing.rerun_layout import layout

if TYPE_CHECKING:
    import rerun as rr

SUFFIX = ".rrd"
_END, _END_BYTES = b"FOOT", 32  # of a whole file


def import_rerun() -> Any:
    """Return the module ``rerun``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("the viewer needs Rerun: pip install 'hybridlio[view]'") from error
    return rerun


def has_display() -> bool:
    """Return whether this machine can show windows."""
    return sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ


def check_target(save: Path | None) -> None:
    """Check that a viewer can be opened, or the file written, before the work begins.

    Raises:
        MissingDependencyError: Rerun is not installed.
        ConfigError: there is no display and no file to save to, or its name does not end in ``.rrd``.
        DataError: the file's folder does not exist.
    """
    import_rerun()
    if save is None:
        if not has_display():
            raise ConfigError("no display to open the viewer on: write a file by --save run.rrd, and open it elsewhere")
        return
    if save.suffix != SUFFIX:
        raise ConfigError(f"{save}: a recording for the viewer is named *{SUFFIX}")
    if not save.parent.is_dir():
        raise DataError(f"{save}: there is no folder {save.parent}")


@contextmanager
def rerun_stream(name: str, save: str | Path | None = None) -> Iterator[rr.RecordingStream]:
    """Open a Rerun recording with the layout of a run: in a new viewer, or as a file that appears whole at the end.

    Args:
        name: shown as the recording's.
        save: the file, ``*.rrd``; None opens the viewer.

    Raises:
        MissingDependencyError, ConfigError, DataError: as :func:`check_target`.
    """
    path = None if save is None else user_path(save)
    check_target(path)
    rr = import_rerun()
    stream = rr.RecordingStream("hybridlio")
    if path is None:
        stream.spawn(default_blueprint=layout(), hide_welcome_screen=True)
        stream.send_recording_name(name)
        yield stream
        stream.flush()
        return
    with atomic_path(path) as part:
        stream.save(part, default_blueprint=layout())
        stream.send_recording_name(name)
        try:
            yield stream
        finally:
            stream.disconnect()  # waits until all is written
        _check_whole(part, path)


def _check_whole(part: Path, path: Path) -> None:
    """Check that a file ends as whole ones do: Rerun only logs that it could not write.

    Raises:
        DataError: it does not.
    """
    with part.open("rb") as file:
        file.seek(max(part.stat().st_size - _END_BYTES, 0))
        if _END not in file.read():
            raise DataError(f"cannot write {path}: the file is cut off; choose a place with free space")
