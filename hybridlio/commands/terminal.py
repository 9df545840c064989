"""What the commands print: results on stdout; progress, warnings and errors on stderr."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text


class Tick(Protocol):
    """Says how far a loop is."""

    def __call__(self, done: int, total: int, detail: str = "") -> None:
        """Say that ``done`` of ``total`` is done, and a word on it."""
        ...


_LINES_APART_S = 1.0
_WIDE = 240


def say(text: str) -> None:
    """Print a line of results, as it is."""
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def say_table(table: Table) -> None:
    """Print a table at the width that it needs, also where that is more than the terminal has."""
    console, wide = Console(), Console(width=_WIDE)
    needed = Measurement.get(wide, wide.options, table).maximum
    (console if needed <= console.width else Console(width=needed)).print(table)


def complain(text: str, style: str = "red") -> None:
    """Print a line of trouble to stderr."""
    _stderr().print(Text(text, style=style), soft_wrap=True)


def set_up_logging(verbosity: int) -> None:
    """Show the library's log: warnings, with 1 also what it does, with 2 everything and where it comes from."""
    logger = logging.getLogger("hybridlio")
    for handler in [h for h in logger.handlers if isinstance(h, _Handler)]:
        logger.removeHandler(handler)
    logger.addHandler(_Handler(verbosity))
    logger.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity, 2)])
    logger.propagate = False
    logging.getLogger("matplotlib").setLevel(logging.WARNING if verbosity else logging.ERROR)


class _Handler(logging.Handler):
    """Lines such as ``warning: …``, above a progress bar where one runs."""

    def __init__(self, verbosity: int) -> None:
        super().__init__()
        self._verbosity = verbosity

    def emit(self, record: logging.LogRecord) -> None:
        where = f" ({record.name})" if self._verbosity > 1 else ""
        style = {logging.WARNING: "yellow", logging.ERROR: "red"}.get(record.levelno, "dim")
        complain(f"{record.levelname.lower()}: {record.getMessage()}{where}", style)


@contextmanager
def progress(what: str, unit: str = "scans") -> Iterator[Tick]:
    """Show how far a loop is: a bar on a terminal, else a line every tenth, a second apart at least.

    Yields:
        A function to call with what is done, what there is in all, and a word on it, such as the distance.
    """
    with (_bar if _stderr().is_terminal else _lines)(what, unit) as tick:
        yield tick


@contextmanager
def _bar(what: str, unit: str) -> Iterator[Tick]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    pace = _Pace(unit)
    with Progress(*columns, console=_stderr()) as bar:
        task = bar.add_task(what, total=None, rate="", detail="")

        def tick(done: int, total: int, detail: str = "") -> None:
            bar.update(task, completed=done, total=total, rate=pace.text(done), detail=detail)

        yield tick


@contextmanager
def _lines(what: str, unit: str) -> Iterator[Tick]:
    pace, shown, last_s = _Pace(unit), 0, 0.0

    def tick(done: int, total: int, detail: str = "") -> None:
        nonlocal shown, last_s
        rate, tenth, spent_s = pace.text(done), 10 * done // max(total, 1), pace.spent_s
        if (tenth > shown and spent_s > last_s + _LINES_APART_S) or (done == total > 0 and shown < 10):
            shown, last_s = tenth, spent_s
            left = pace.seconds_for(total - done)
            words = [f"{done}/{total} {unit} ({100 * done // total} %)", rate, f"{left:.0f} s left"]
            complain(f"{what}: {', '.join([*words, *([detail] if detail else [])])}", "none")

    yield tick


class _Pace:
    """How quickly a loop goes. One that goes on where an earlier one stopped is not credited with what that did."""

    def __init__(self, unit: str) -> None:
        self._unit, self._start = unit, time.perf_counter()
        self._before: int | None = None
        self._per_s = 0.0

    @property
    def spent_s(self) -> float:
        return max(time.perf_counter() - self._start, 1e-9)

    def text(self, done: int) -> str:
        if self._before is None:
            self._before = max(done - 1, 0)
        self._per_s = (done - self._before) / self.spent_s
        return f"{self._per_s:.1f} {self._unit}/s"

    def seconds_for(self, more: int) -> float:
        return more / max(self._per_s, 1e-9)


@functools.cache
def _stderr() -> Console:
    """One console for all, so that lines and bars do not write over each other; it finds stderr anew each time."""
    return Console(stderr=True)
