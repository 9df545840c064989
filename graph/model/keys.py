"""Names of poses: an integer, or (robot, index) where several robots share a graph.

In text formats, which know integers only, (robot, index) is written as GTSAM's symbols are: the robot's letter, ``a``
for robot 0, in the top byte.
"""

from __future__ import annotations

from typing import TypeAlias

from hybridlio.core.errors import GraphError

Key: TypeAlias = "int | tuple[int, int]"

_INDEX_BITS = 56
_FIRST_LETTER = ord("a")
_LAST_ROBOT = 127 - _FIRST_LETTER  # the top byte stays within a signed 64-bit integer
PLAIN_KEYS = _FIRST_LETTER << _INDEX_BITS  # integers below it are keys by themselves


def check_key(key: object) -> Key:
    """The key, as plain integers.

    Raises:
        GraphError: neither an integer nor (robot, index), or out of range.
    """
    if isinstance(key, tuple) and len(key) == 2:
        robot, index = (_integer(part, key) for part in key)
        if robot > _LAST_ROBOT or index >= 1 << _INDEX_BITS:
            raise GraphError(f"key {key!r}: a robot is at most {_LAST_ROBOT}, an index below 2**{_INDEX_BITS}")
        return robot, index
    number = _integer(key, key)
    if number >= PLAIN_KEYS:
        raise GraphError(f"key {key!r}: an integer key is below {PLAIN_KEYS}")
    return number


def _integer(value: object, key: object) -> int:
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise GraphError(f"key {key!r}: a key is an integer or (robot, index), both integers")
    number = int(value.__index__())
    if number < 0:
        raise GraphError(f"key {key!r}: keys are not negative")
    return number


def to_integer(key: Key) -> int:
    """The key as text formats have it."""
    if isinstance(key, int):
        return key
    robot, index = key
    return (_FIRST_LETTER + robot << _INDEX_BITS) | index


def from_integer(number: int) -> Key:
    """Inverse of :func:`to_integer`.

    Raises:
        GraphError: no key has this number.
    """
    letter = number >> _INDEX_BITS
    if letter < _FIRST_LETTER:
        return check_key(number)
    return check_key((letter - _FIRST_LETTER, number & ((1 << _INDEX_BITS) - 1)))


def named(keys: list[Key], most: int = 10) -> str:
    """The keys for a message, the first few of many."""
    text = ", ".join(str(key) for key in keys[:most])
    return text if len(keys) <= most else f"{text} and {len(keys) - most} more"
