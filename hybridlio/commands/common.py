"""What the commands share: options, and how errors and interrupts end."""

from __future__ import annotations

import functools
import signal
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, NoReturn, ParamSpec

import typer

from hybridlio.commands.terminal import complain, set_up_logging
from hybridlio.core.errors import ConfigError, DataError, HybridLioError
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES

if TYPE_CHECKING:
    from hybridlio.datasets.sequence import Sequence
    from hybridlio.odometry.config import Config

_P = ParamSpec("_P")

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130

_verbosity = 0


def start_quietly(count: int) -> int:
    """Take ``-v`` before the command's name; called at each start."""
    global _verbosity
    _verbosity = 0
    return be_verbose(count)


def be_verbose(count: int) -> int:
    """Take ``-v`` after the command's name."""
    global _verbosity
    _verbosity = max(_verbosity, count)
    set_up_logging(_verbosity)
    return count


Verbose = Annotated[
    int,
    typer.Option(
        "-v",
        "--verbose",
        count=True,
        metavar=" ",
        show_default=False,
        callback=be_verbose,
        help="Log more; twice: everything, and tracebacks.",
    ),
]
Data = Annotated[
    Path, typer.Argument(metavar="DATA", help="A recording: its folder, or one above it.", show_default=False)
]
SequenceName = Annotated[
    str | None, typer.Option("--sequence", metavar="NAME", help="Which recording, where DATA holds several.")
]
ReaderName = Annotated[
    str | None, typer.Option("--reader", metavar="NAME", help="kitti-raw, kitti-odometry or folder; else guessed.")
]
RawRoot = Annotated[
    Path | None,
    typer.Option("--raw-root", metavar="DIR", help="For KITTI odometry: KITTI's raw data, to take the IMU from."),
]
VerticalAngle = Annotated[
    float | None,
    typer.Option(
        "--vertical-angle",
        metavar="DEG",
        help="Raise points by this angle; by default 0.205 for KITTI's own, else 0.",
    ),
]
Frames = Annotated[str | None, typer.Option("--frames", metavar="A:B", help="Only scans A to B-1, counted from 0.")]
InitialPoseName = Annotated[
    str | None, typer.Option("--initial-pose", metavar="NAME", help=", ".join(INITIAL_POSE_SOURCES))
]
ResidualName = Annotated[str | None, typer.Option("--residual", metavar="NAME", help=", ".join(RESIDUAL_SOURCES))]
BackendName = Annotated[str | None, typer.Option("--backend", metavar="NAME", help=", ".join(BACKENDS))]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings, as `hybridlio config` prints them.")
]


def guarded(command: Callable[_P, None]) -> Callable[_P, None]:
    """The command with one line for each error, and the exit code that belongs to it."""

    @functools.wraps(command)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, _interrupt)
        try:
            command(*args, **kwargs)
        except (typer.Exit, typer.BadParameter):
            raise
        except BaseException as error:
            fail(error)

    return run


def fail(error: BaseException, code: int | None = None) -> NoReturn:
    """Say what went wrong and exit: 2 for input that cannot be used, 1 for other failures, 130 when interrupted.

    Args:
        error: what was raised.
        code: the exit code in place of 1 or 2.
    """
    if _verbosity > 1:
        complain("".join(traceback.format_exception(error)), "dim")
    if isinstance(error, KeyboardInterrupt):
        complain("interrupted")
        raise typer.Exit(INTERRUPTED) from None
    if isinstance(error, HybridLioError):
        complain(f"error: {error}")
        bad_input = isinstance(error, ConfigError | DataError)
        raise typer.Exit(code or (BAD_INPUT if bad_input else FAILED)) from None
    if isinstance(error, SystemExit | GeneratorExit):
        raise error
    if isinstance(error, OSError) and error.strerror:  # a full disk, missing rights: the system's, and not a fault
        complain(f"error: {error.filename}: {error.strerror}" if error.filename else f"error: {error.strerror}")
        raise typer.Exit(code or FAILED) from None
    if isinstance(error, MemoryError):
        complain("error: out of memory; give less at once, such as a part of the recording by --frames")
        raise typer.Exit(code or FAILED) from None
    complain(f"error: {type(error).__name__}: {error} (a fault in hybridlio; -vv shows where)")
    raise typer.Exit(FAILED) from None


def open_data(
    data: Path,
    sequence: str | None,
    reader: str | None,
    raw_root: Path | None,
    frames: str | None,
    vertical_angle_deg: float | None,
) -> Sequence:
    """The recording that the options mean, or the asked-for part of it."""
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.datasets.sequence import frame_range, part_of

    if frames is not None:
        frame_range(frames)  # a misspelt range is said before a large recording is looked through
    whole = open_sequence(
        data, sequence=sequence, reader=reader, raw_root=raw_root, vertical_angle_deg=vertical_angle_deg
    )
    return part_of(whole, frames)


def settings(config: Path | None, **names: str | None) -> Config:
    """The configuration in a file, or the default one, with the names given on the command line."""
    from hybridlio.odometry.config import Config, load_config

    settings = load_config(config) if config is not None else Config()
    return settings.model_copy(update={name: value for name, value in names.items() if value is not None})


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
