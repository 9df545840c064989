"""The log of a run: into a file in a batch, and without warnings about results that are replaced."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_log = logging.getLogger("hybridlio")


@contextmanager
def logged_to(file: Path) -> Iterator[None]:
    """Write what hybridlio and matplotlib log in this thread to a file."""
    thread = threading.get_ident()
    handler = logging.FileHandler(file, mode="w", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.addFilter(lambda record: record.thread == thread)
    loggers, level = (_log, logging.getLogger("matplotlib")), _log.level
    for logger in loggers:
        logger.addHandler(handler)
    _log.setLevel(min(logging.INFO, level) if level else logging.INFO)
    try:
        yield
    finally:
        _log.setLevel(level)
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


class HeldBack(logging.Handler):
    """Holds back hybridlio's warnings of one thread, and passes on everything else.

    A search that repeats a run would else warn about results that its next round replaces.
    """

    def __init__(self) -> None:
        super().__init__()
        self._thread, self._handlers, self._propagates = threading.get_ident(), list(_log.handlers), _log.propagate
        self._records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Hold a warning of this thread back."""
        if record.thread == self._thread and record.levelno == logging.WARNING:
            self._records.append(record)
            return
        for handler in self._handlers:
            if record.levelno >= handler.level:
                handler.handle(record)
        if self._propagates and _log.parent is not None:
            _log.parent.callHandlers(record)

    def __enter__(self) -> HeldBack:
        _log.handlers, _log.propagate = [self], False
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        _log.handlers, _log.propagate = self._handlers, self._propagates
        if error is not None:  # they may say why
            self.show()

    def show(self) -> None:
        """Show what was held back."""
        for record in self._records:
            _log.handle(record)
        self._records.clear()
