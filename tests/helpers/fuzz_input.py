"""Something that hybridlio reads, to be damaged, and what comes of reading it.

The limit of time is one of processor time, so that the load of the machine does not matter. What waits without
computing is seen by the process that watches (fuzz_readers.py).
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from hybridlio.core.errors import HybridLioError, strip_control

HANG_S, MEMORY_BYTES = 10.0, 2 << 30


@dataclass(frozen=True)
class Input:
    """An input: how its files are written into a folder, and how they are read.

    Attributes:
        write: writes the whole files below a folder, and returns what ``read`` takes.
        read: reads everything; raises a :class:`HybridLioError` where that is impossible.
    """

    write: Callable[[Path], Any]
    read: Callable[[Any], object]


class HangError(BaseException):
    """Reading took too long; no ordinary exception, so that no reader catches it."""


@contextmanager
def limited_time(limit_s: float) -> Iterator[None]:
    """Raise :class:`HangError` after so much processor time; 0 for no limit."""

    def hangs(_signal: int, _frame: Any) -> NoReturn:
        raise HangError

    signal.signal(signal.SIGPROF, hangs)
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def outcome(read: Callable[[Any], object], arguments: Any, limit_s: float = HANG_S) -> str:
    """Return ``ok``, ``error`` for one clear line, or what is wrong."""
    try:
        with limited_time(limit_s):
            read(arguments)
    except HybridLioError as error:
        return _judged(str(error))
    except HangError:
        return f"takes over {limit_s:g} s"
    except MemoryError:
        return "takes over 2 GiB"
    except BaseException as error:
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        where = f"{Path(place.tb_frame.f_code.co_filename).name}:{place.tb_lineno}" if place else ""
        return f"{type(error).__name__}: {error} at {where}"
    return "ok"


def _judged(text: str) -> str:
    if not text.strip():
        return "an error without a text"
    return "error" if text == strip_control(text) else f"control characters in {text!r}"
