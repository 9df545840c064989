"""Notes on what is unusual in a recording."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

_log = logging.getLogger(__name__)


@dataclass
class Notes:
    """Notes that a reader collects while it opens a recording; each is also logged once.

    Attributes:
        name: the recording's name, which starts each log message.
        texts: the notes so far.
    """

    name: str
    texts: list[str] = field(default_factory=list)

    def add(self, text: str) -> None:
        """Keep a note and log it as a warning, unless the same text has been added before."""
        if text not in self.texts:
            self.texts.append(text)
            _log.warning("%s: %s", self.name, text)

    def found(self, text: str) -> None:
        """Keep a note on a convention that was found and needs no attention; log it as information."""
        if text not in self.texts:
            self.texts.append(text)
            _log.info("%s: %s", self.name, text)
