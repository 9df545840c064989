"""The log file of a run in a batch."""

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
