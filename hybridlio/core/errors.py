"""The errors that the library raises. Messages say what is wrong, where (file, row, frame index), and what to do."""

import re
import reprlib

_SEQUENCE = re.compile(
    r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?"
)  # colours, titles, cursor (ECMA-48)
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")  # all but tab and newline

_LONGEST = 2000  # characters of a message: half a screen; a name in a damaged file may be as long as the file


def strip_control(text: str) -> str:
    """Return the text without control characters, which a file's name or content could send to the terminal."""
    return _CONTROL.sub("", _SEQUENCE.sub("", text))


def shown(value: object) -> str:
    """Return a value that a user gave, for a message: on one line and short."""
    return strip_control(" ".join(reprlib.repr(value).split()))


class HybridLioError(Exception):
    """Base class of all errors that the library raises on purpose.

    Messages have no control characters of a file's, and of one that a file makes long the middle is left out.
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(*(_clear(one) if isinstance(one, str) else one for one in arguments))


def _clear(message: str) -> str:
    text, half = strip_control(message), _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} … {text[-half:]}"


class DataError(HybridLioError):
    """A recording, file or measurement is missing, malformed or not finite."""


class ConfigError(HybridLioError):
    """A setting is unknown, out of range or contradicts another one."""


class EstimationError(HybridLioError):
    """A pose cannot be estimated from the input (registration, start-up, alignment)."""


class GraphError(HybridLioError):
    """A factor graph is malformed or under-constrained; the message names the keys."""


class MissingDependencyError(HybridLioError):
    """An optional Python package or a system library is missing; the message gives the command that installs it."""
