"""Notes on what is unusual in a recording, of three kinds; what is wrong raises an error instead.

* *corrected*: the data were changed, and the result is right;
* *doubtful*: the data are used as they are, and the user should check something;
* *found*: a convention that was told from the data and needs no attention.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

_log = logging.getLogger(__name__)

Kind = Literal["corrected", "doubtful", "found"]


class Note(str):
    """The text of a note, with its kind."""

    kind: Kind

    __slots__ = ("kind",)

    def __new__(cls, text: str, kind: Kind = "doubtful") -> Note:
        """Return a note of a kind."""
        note = super().__new__(cls, text)
        note.kind = kind
        return note

    def __getnewargs__(self) -> tuple[str, Kind]:  # type: ignore[override]
        return str(self), self.kind


def kind_of(note: str) -> Kind:
    """Return the kind of a note; plain text is doubtful."""
    return note.kind if isinstance(note, Note) else "doubtful"


def labelled(notes: Iterable[str]) -> list[str]:
    """Return the notes, each with its kind before it."""
    return [f"{kind_of(note)}: {note}" for note in notes]


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
        """Keep a note on something doubtful, which says what to do, and log it."""
        self._keep(text, "doubtful", logging.WARNING)

    def corrected(self, text: str) -> None:
        """Keep a note on data that were changed, and log it."""
        self._keep(text, "corrected", logging.WARNING)

    def found(self, text: str) -> None:
        """Keep a note on a convention that was found and needs no attention; log it as information."""
        self._keep(text, "found", logging.INFO)

    def _keep(self, text: str, kind: Kind, level: int) -> None:
        if text not in self.texts:
            self.texts.append(Note(text, kind))
            _log.log(level, "%s: %s", self.name, text, extra={"kind": kind})
