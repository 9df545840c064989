"""Something that hybridlio reads, to be damaged, and what comes of reading it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from hybridlio.core.errors import HybridLioError, strip_control

HANG_S, MEMORY_BYTES = 10, 2 << 30


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
    """Reading took over 10 s; no ordinary exception, so that no reader catches it."""


@contextmanager
def limited_time() -> Iterator[None]:
    """Raise :class:`HangError` after 10 s."""

    def hangs(_signal: int, _frame: Any) -> NoReturn:
        raise HangError

    signal.signal(signal.SIGALRM, hangs)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)


def outcome(read: Callable[[Any], object], arguments: Any) -> str:
    """Return ``ok``, ``error`` for one clear line, or what is wrong."""
    try:
        with limited_time():
            read(arguments)
    except HybridLioError as error:
        return _judged(str(error))
    except HangError:
        return f"takes over {HANG_S} s"
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
