"""What the commands share: common options, and the exit codes of errors and interrupts."""

from __future__ import annotations

import errno
import functools
import inspect
import signal
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec

import typer

from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_message, progress, set_up_logging
from hybridlio.core.errors import ConfigError, DataError, HybridLioError
from hybridlio.datasets.rosbag.choices import BagTopics, option_of
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES

if TYPE_CHECKING:
    from hybridlio.datasets.sequence import Sequence
    from hybridlio.odometry.config import Config

_P = ParamSpec("_P")

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130  # exit codes; 130 is the shell's for SIGINT (128 + 2)
_VERBOSITY = "_verbosity"  # the parameter that every command has


class PartialResultError(Exception):
    """Ends a command that wrote part of its result. The cause is printed; the exit code is ``FAILED``."""


def set_verbosity(context: typer.Context, count: int) -> int:
    """Set up logging for ``-v``, which may stand before and after the command's name; the larger count applies."""
    before = 0 if context.parent is None else context.parent.params[_VERBOSITY]
    verbosity = max(before, count)
    set_up_logging(verbosity)
    return verbosity


Verbose = Annotated[
    int,
    typer.Option(
        "-v",
        "--verbose",
        count=True,
        metavar=" ",
        show_default=False,
        callback=set_verbosity,
        help="Print more log messages; -vv: all of them, and tracebacks.",
    ),
]
Data = Annotated[
    Path, typer.Argument(metavar="DATA", help="A recording or bag, or a folder that contains one.", show_default=False)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
SequenceName = Annotated[
    str | None, typer.Option("--sequence", metavar="NAME", help="The recording to use if DATA contains several.")
]
SequenceNames = Annotated[
    str | None, typer.Option("--sequence", metavar="A,B,…", help="The recordings to use if DATA contains several.")
]
ReaderName = Annotated[
    str | None,
    typer.Option(
        "--reader",
        metavar="NAME",
        autocompletion=completion.reader,
        help="kitti-raw, kitti-odometry, folder, rosbag, ouster, velodyne, or a data set: kitti-360, nuscenes, nclt, "
        "mulran, helipr, boreas, newer-college, argoverse-2, apollo, tum-rgbd; by default detected from the files.",
    ),
]
RawRoot = Annotated[
    Path | None,
    typer.Option("--raw-root", metavar="DIR", help="KITTI raw data that provide the IMU of KITTI odometry sequences."),
]
VerticalAngle = Annotated[
    float | None,
    typer.Option(
        "--vertical-angle",
        metavar="DEG",
        help="Correct the elevation of all points by this angle; default: 0.205 for recordings by KITTI, else 0.",
    ),
]
Rate = Annotated[
    float | None,
    typer.Option("--rate", metavar="HZ", help="Scans per second, for a folder of scans without a file of stamps."),
]
Check = Annotated[
    bool,
    typer.Option(
        "--check/--no-check", help="Compare the IMU with the scans first: clocks, units, mounting (some seconds)."
    ),
]
Frames = Annotated[str | None, typer.Option("--frames", metavar="A:B", help="Use scans A to B-1 only, counted from 0.")]
Start = Annotated[
    int | None, typer.Option("--start", "--jump", "-j", metavar="N", min=0, help="Leave out the first N scans.")
]
ScanCount = Annotated[
    int | None,
    typer.Option("--n-scans", "-n", metavar="N", min=1, help="Use N scans at most, after --start and --every."),
]
Every = Annotated[
    int, typer.Option("--every", metavar="N", min=1, help="Use one scan in N, from the first one that is not left out.")
]
InitialPoseName = Annotated[
    str | None,
    typer.Option(
        "--initial-pose",
        metavar="NAME",
        autocompletion=completion.initial_pose,
        help=f"Source of initial poses: {', '.join(INITIAL_POSE_SOURCES)}.",
    ),
]
ResidualName = Annotated[
    str | None,
    typer.Option(
        "--residual",
        metavar="NAME",
        autocompletion=completion.residual,
        help=f"Source of residuals, which correct initial poses: {', '.join(RESIDUAL_SOURCES)}.",
    ),
]
BackendName = Annotated[
    str | None,
    typer.Option(
        "--backend", metavar="NAME", autocompletion=completion.backend, help=f"Factor graph: {', '.join(BACKENDS)}."
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings file, as printed by `hybridlio config`.")
]


_TOPIC_HELP = {
    "lidar": "Topic of the point clouds; give it several times to merge lidars.",
    "imu": "Topic of the inertial data; `none` to use none.",
    "gps": "Topic of the GPS fixes; `none` to use none.",
    "reference": "Topic of reference poses; `none` to use none.",
    "imu_frame": "Frame of the IMU, in place of that in its messages.",
    "lidar_frame": "Frame of the lidar, in place of that in its messages.",
}


def with_topic_options(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command whose parameter ``topics`` is a :class:`BagTopics`; it gets one option for each attribute.

    Options are declared once here: typer takes them from the signature, which shows no ``topics``.
    """

    @functools.wraps(command)
    def run(**kwargs: Any) -> None:
        names = {name: kwargs.pop(_topic_parameter(name)) for name in _TOPIC_HELP}
        names["lidar"] = ",".join(names["lidar"]) if names["lidar"] else None
        command(**kwargs, topics=BagTopics(**names))

    signature = inspect.signature(command, eval_str=True)
    parameters = [p for name, p in signature.parameters.items() if name != "topics"]
    options = [_topic_option(name, text) for name, text in _TOPIC_HELP.items()]
    run.__signature__ = signature.replace(parameters=[*parameters, *options])  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in [*parameters, *options]} | {"return": None}
    return run


def _topic_parameter(name: str) -> str:
    return option_of(name).removeprefix("--").replace("-", "_")


def _topic_option(name: str, text: str) -> inspect.Parameter:
    option = typer.Option(option_of(name), metavar="NAME", help=text, rich_help_panel="Bags")
    kind = list[str] | None if name == "lidar" else str | None
    return inspect.Parameter(
        _topic_parameter(name), inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, option]
    )


def guarded(command: Callable[_P, None]) -> Callable[_P, None]:
    """Wrap a command so that an error is printed as one line and sets the exit code."""

    @functools.wraps(command)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> None:
        verbosity = kwargs.get(_VERBOSITY)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, _interrupt)
        try:
            command(*args, **kwargs)
        except (typer.Exit, typer.BadParameter):
            raise
        except BaseException as error:
            _fail(error, verbosity if isinstance(verbosity, int) else 0)

    return run


def _fail(error: BaseException, verbosity: int) -> NoReturn:
    """Print an error and exit: 2 for input that cannot be used, 1 for other failures, 130 for an interrupt."""
    is_partial = isinstance(error, PartialResultError)
    if is_partial and error.__cause__ is not None:
        error = error.__cause__
    if verbosity > 1:
        print_message("".join(traceback.format_exception(error)), "dim")
    if isinstance(error, KeyboardInterrupt):
        print_message("interrupted")
        raise typer.Exit(INTERRUPTED) from None
    if isinstance(error, SystemExit | GeneratorExit):
        raise error
    print_message(f"error: {_describe(error)}")
    is_bad_input = isinstance(error, ConfigError | DataError) and not is_partial
    raise typer.Exit(BAD_INPUT if is_bad_input else FAILED) from None


def _describe(error: BaseException) -> str:
    if isinstance(error, HybridLioError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:  # the system refused, such as a full disk: not a bug
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        return f"{text}; make room there, or choose another place" if error.errno == errno.ENOSPC else text
    if isinstance(error, MemoryError):
        return "out of memory; process part of the recording with --frames"
    return f"{type(error).__name__}: {error} (a bug in hybridlio; run again with -vv for the traceback)"


def open_data(
    data: Path,
    sequence: str | None,
    reader: str | None,
    raw_root: Path | None,
    frames: str | None,
    vertical_angle_deg: float | None,
    topics: BagTopics,
    rate_hz: float | None,
) -> Sequence:
    """Open the recording that the options name, or the part of it in ``frames``."""
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.datasets.sequence import frame_range, part_of

    if frames is not None:
        frame_range(frames)  # report a malformed range before opening a large recording
    whole = open_sequence(
        data,
        sequence=sequence,
        reader=reader,
        raw_root=raw_root,
        vertical_angle_deg=vertical_angle_deg,
        topics=topics,
        rate_hz=rate_hz,
    )
    return part_of(whole, frames)


def check_data(recording: Sequence, check: bool) -> Sequence:
    """Return the recording with its IMU compared with its scans, and corrected; unchanged without ``check``."""
    if not check:
        return recording
    from hybridlio.runs.recording_check import check_recording

    with progress("checking the IMU") as report:
        return check_recording(recording, report)


def range_of(frames: str | None, start: int | None, count: int | None, every: int = 1) -> str | None:
    """Return the range of scans in which ``--frames``, or ``--start`` and ``--n-scans``, leave the recording.

    As for KISS-ICP, ``--n-scans`` counts the scans that are used: with ``--every`` they lie in a longer range.

    Raises:
        ConfigError: both are given.
    """
    if start is None and count is None:
        return frames
    if frames is not None:
        raise ConfigError("--frames and --start or --n-scans choose the scans both; give one of them")
    first = start or 0
    return f"{first}:{'' if count is None else first + count * every}"


def load_settings(config: Path | None, **names: str | None) -> Config:
    """Return the configuration in a file, or the default one, with the names given on the command line."""
    from hybridlio.odometry.config import Config, load_config

    settings = load_config(config) if config is not None else Config()
    return settings.model_copy(update={name: value for name, value in names.items() if value is not None})


def split_names(text: str) -> tuple[str, ...]:
    """Return the names in comma-separated text, without empty ones."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
