"""Keys of poses: an integer, or (robot, index) where several robots share a graph.

Text formats know only integers. There, (robot, index) is packed like a GTSAM symbol: the robot's letter in the top byte
(``a`` for robot 0), the index in the other seven.
"""

from __future__ import annotations

import operator
from typing import TypeAlias

from hybridlio.core.errors import GraphError, shown

Key: TypeAlias = "int | tuple[int, int]"

_INDEX_BITS = 56  # of GTSAM's 64-bit symbols; the letter takes the other eight
_FIRST_LETTER = ord("a")  # of robot 0; data sets of several robots call them a, b, c
_LAST_ROBOT = 127 - _FIRST_LETTER  # keeps the packed key within a signed 64-bit integer
PLAIN_KEYS = _FIRST_LETTER << _INDEX_BITS  # integers below it are not packed
_LISTED_KEYS = 10  # in a message, which then fits on a screen; the rest is counted


def check_key(key: object) -> Key:
    """Return the key as plain integers; ``gtsam.symbol("b", 5)`` is ``(1, 5)``.

    Raises:
        GraphError: neither an integer nor (robot, index), or out of range.
    """
    if isinstance(key, tuple) and len(key) == 2:
        robot, index = (_check_integer(part, key) for part in key)
        if robot > _LAST_ROBOT or index >= 1 << _INDEX_BITS:
            raise GraphError(f"key {key!r}: a robot must be at most {_LAST_ROBOT}, an index below 2**{_INDEX_BITS}")
        return robot, index
    number = _check_integer(key, key)
    return number if number < PLAIN_KEYS else from_integer(number)  # a symbol of GTSAM's


def _check_integer(value: object, key: object) -> int:
    try:
        number = operator.index(value)  # type: ignore[arg-type]  # whether it is one is the question
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise GraphError(f"key {shown(key)}: a key must be an integer or (robot, index), both integers")
    if number < 0:
        raise GraphError(f"key {shown(key)}: a key must not be negative")
    return number


def to_integer(key: Key) -> int:
    """Return the key as the integer that text formats hold."""
    if isinstance(key, int):
        return key
    robot, index = key
    return (_FIRST_LETTER + robot << _INDEX_BITS) | index


def from_integer(number: int) -> Key:
    """Return the key that a text format's integer stands for; inverse of :func:`to_integer`.

    Raises:
        GraphError: no key has this number.
    """
    letter = number >> _INDEX_BITS
    if letter < _FIRST_LETTER:
        return check_key(number)
    if letter > 127:
        raise GraphError(f"key {number}: an integer key must be below {PLAIN_KEYS}, or a symbol of GTSAM's")
    return check_key((letter - _FIRST_LETTER, number & ((1 << _INDEX_BITS) - 1)))


def lettered(letter: str, index: int) -> Key:
    """Return the key that GTSAM's symbol of a letter and an index stands for."""
    return ord(letter) - _FIRST_LETTER, index


def list_keys(keys: list[Key]) -> str:
    """Return the keys as text for a message: the first ten, then the count of the rest."""
    text = ", ".join(str(key) for key in keys[:_LISTED_KEYS])
    return text if len(keys) <= _LISTED_KEYS else f"{text} and {len(keys) - _LISTED_KEYS} more"
