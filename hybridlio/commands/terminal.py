"""Terminal output of the commands: results on stdout; progress, warnings and errors on stderr."""

from __future__ import annotations

import functools
import io
import logging
import os
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any, cast

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from hybridlio.core.errors import strip_control
from hybridlio.core.progress import Progress

_LINE_INTERVAL_S = 1.0  # keeps the log of a short run to a few lines
_WIDEST_TABLE = 240  # columns; more than any table here needs


def print_result(text: str) -> None:
    """Print a line to stdout without markup; on a terminal it wraps between words, elsewhere not at all."""
    with _named_stdout():
        _print(Console(), Text(strip_control(text)))


@contextmanager
def _named_stdout() -> Iterator[None]:
    """Name stdout in an error of the system's, such as of a full disk."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, "<stdout>") from None


def print_table(table: Table) -> None:
    """Print a table to stdout at its full width, even where the terminal is narrower."""
    console, wide = Console(), Console(width=_WIDEST_TABLE)
    needed = Measurement.get(wide, wide.options, table).maximum
    with _named_stdout():
        (console if needed <= console.width else Console(width=needed)).print(table)


def print_message(text: str, style: str = "red") -> None:
    """Print a line to stderr; red, as an error, unless ``style`` is given."""
    _print(_stderr(), Text(strip_control(text), style=style))


def _print(console: Console, text: Text) -> None:
    """Print text; on a terminal wrapped between words, with longer words (paths) whole, elsewhere without wrapping."""
    if console.is_terminal:
        lines = [part for line in text.plain.split("\n") for part in _wrapped(line, console.width)]
        text = Text("\n".join(lines), style=text.style)
    console.print(text, soft_wrap=True)


def _wrapped(line: str, width: int) -> list[str]:
    """Return a line in parts of at most ``width`` characters, broken between words; rich breaks long words, too."""
    if len(line) <= width:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.wrap(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def print_warning(text: str) -> None:
    """Print ``warning: …`` to stderr."""
    print_message(f"warning: {text}", "yellow")


def set_up_logging(verbosity: int) -> None:
    """Print the library's log to stderr: warnings; from 1 on also information; from 2 on also debugging output.

    What the terminal's encoding lacks, such as the bytes of a name that is not UTF-8, is printed as an escape.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    logger = logging.getLogger("hybridlio")
    for handler in [h for h in logger.handlers if isinstance(h, _Handler)]:
        logger.removeHandler(handler)
    logger.addHandler(_Handler(verbosity))
    logger.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity, 2)])
    logger.propagate = False
    logging.getLogger("matplotlib").setLevel(logging.WARNING if verbosity else logging.ERROR)


@contextmanager
def notes_held_back() -> Iterator[None]:
    """Print no notes on recordings, for a command that shows them itself; after an error print them all."""
    handlers = [h for h in logging.getLogger("hybridlio").handlers if isinstance(h, _Handler)]
    for handler in handlers:
        handler.held = []
    try:
        yield
    except Exception:
        for handler in handlers:
            handler.print_held()
        raise
    finally:
        for handler in handlers:
            handler.held = None


class _Handler(logging.Handler):
    """Print records as ``warning: …`` or with a note's kind, ``corrected: …``, above a progress bar if one is shown.

    Attributes:
        held: the notes that are kept back for now; None to print them.
    """

    def __init__(self, verbosity: int) -> None:
        super().__init__()
        self._verbosity = verbosity
        self.held: list[logging.LogRecord] | None = None

    def print_held(self) -> None:
        """Print the notes that were kept back."""
        held, self.held = self.held or [], None
        for record in held:
            self.emit(record)

    def emit(self, record: logging.LogRecord) -> None:
        if self.held is not None and hasattr(record, "kind"):
            self.held.append(record)
            return
        logger_name = f" ({record.name})" if self._verbosity > 1 else ""
        label = getattr(record, "kind", record.levelname.lower())  # a note's kind says more than its level
        style = {logging.WARNING: "yellow", logging.ERROR: "red"}.get(record.levelno, "dim")
        print_message(f"{label}: {record.getMessage()}{logger_name}", "none" if label == "corrected" else style)


@contextmanager
def progress(task: str, unit: str = "scans", units: Mapping[str, str] | None = None) -> Iterator[Progress]:
    """Show the progress of a loop: a bar on a terminal, otherwise a line after every tenth of the work.

    Args:
        task: what the loop does.
        unit: what it counts.
        units: what it counts in its stages that count something else, by their names.

    Yields:
        The callback to report progress to. A further stage begins where the count falls or its unit changes.
    """
    with (_bar if _stderr().is_terminal else _lines)(task, _Pace(unit, units or {})) as report:
        yield report


@contextmanager
def _bar(task: str, pace: _Pace) -> Iterator[Progress]:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[stage]}"),
    )
    with ProgressBar(*columns, console=_stderr()) as bar:
        row = bar.add_task(task, total=None, rate="", stage="")

        def report(stage: str, done: int, total: int) -> None:
            if pace.update(stage, done):
                bar.reset(row)
            bar.update(row, completed=done, total=total, rate=str(pace), stage=stage)

        yield report


@contextmanager
def _lines(task: str, pace: _Pace) -> Iterator[Progress]:
    printed_tenth, printed_s = 0, 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal printed_tenth, printed_s
        if pace.update(stage, done):
            printed_tenth = 0
        tenth, now_s = 10 * done // max(total, 1), time.perf_counter()
        is_due = tenth > printed_tenth and now_s > max(printed_s, pace.begun_s) + _LINE_INTERVAL_S
        is_last = done == total > 0 and printed_tenth < 10
        if is_due or is_last:
            printed_tenth, printed_s = tenth, now_s
            words = [f"{done}/{total} {pace.unit} ({100 * done // total} %)", str(pace)]
            words += [f"{pace.seconds_for(total - done):.0f} s left", *([stage] if stage else [])]
            print_message(f"{task}: {', '.join(words)}", "none")

    yield report


class _Pace:
    """Units of work per second, counted from a stage's first report: work that was resumed does not count as fast."""

    def __init__(self, unit: str, units: Mapping[str, str]) -> None:
        self._usual, self._units, self.unit = unit, units, unit
        self.begun_s = self._reported_s = time.perf_counter()
        self._done_before: int | None = None
        self._done, self._per_s = 0, 0.0

    def __str__(self) -> str:
        return f"{self._per_s:.1f} {self.unit}/s"

    def update(self, stage: str, done: int) -> bool:
        """Take a report; return whether it begins a further stage: the count falls, or something else is counted."""
        unit = self._units.get(stage, self._usual)
        is_next = done < self._done or (unit != self.unit and self._done > 0)
        if is_next:
            self.begun_s, self._done_before = self._reported_s, None
        if self._done_before is None:
            self._done_before = max(done - 1, 0)
        self.unit, self._done, self._reported_s = unit, done, time.perf_counter()
        self._per_s = (done - self._done_before) / max(self._reported_s - self.begun_s, 1e-9)
        return is_next

    def seconds_for(self, units: int) -> float:
        return units / max(self._per_s, 1e-9)


class _LastingStderr:
    """stderr as it is at each use. Once it takes nothing more (a closed pipe, a full disk), it is silent.

    Progress that nobody sees must not stop a run of hours.
    """

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def _stream(self) -> Any:
        return getattr(sys.stderr, "rich_proxied_file", sys.stderr)  # below what a bar puts in its place

    def write(self, text: str) -> int:
        """Write text, or mute stderr."""
        with self._muted_if_broken():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or mute stderr."""
        with self._muted_if_broken():
            self._stream.flush()

    @contextmanager
    def _muted_if_broken(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # what is buffered would fail again at the end of the process
            os.close(nowhere)


@functools.cache
def _stderr() -> Console:
    """Return the one console for stderr, which keeps bars and lines apart; it looks stderr up at each print."""
    return Console(file=cast("IO[str]", _LastingStderr()))
