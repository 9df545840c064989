"""Values as bytes, and back bit for bit: numbers, text, arrays, containers, and objects of hybridlio's own classes.

Used for the state of an odometry, which a run keeps on disk. Pickle would do the same, but a pickle can run any code
when it is read. Here a class is found by its name among hybridlio's own, and only its attributes are set; a dataclass
is made by its constructor, which checks them.
"""

from __future__ import annotations

import dataclasses
import dis
import importlib
import json
import struct
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, Literal, cast

import numpy as np

from hybridlio.core.errors import DataError

_PACKAGE = "hybridlio."
_KINDS = "biufU"  # of NumPy types: numbers and text, no objects
_PLAIN = (bool, int, float, str, type(None))
_LENGTHS = struct.Struct("<Q")

_Convert = Callable[[Any], Any]
_foreign: dict[str, tuple[type, _Convert, _Convert]] = {}


def register(name: str, kind: type, to_plain: _Convert, from_plain: _Convert) -> None:
    """Let objects of a class of another library be encoded, by two functions that convert them to plain values."""
    _foreign[name] = (kind, to_plain, from_plain)


def encode(value: Any) -> bytes:
    """Return a value as bytes.

    Raises:
        TypeError: it holds an object of a class that is not hybridlio's; names the class.
    """
    writer = _Writer()
    node = writer.node(value)
    tables = [list(writer.layouts), writer.kinds, list(writer.classes)]
    tree = json.dumps([node, *tables], separators=(",", ":")).encode()
    return b"".join([_LENGTHS.pack(len(tree)), tree, *writer.data])


def decode(data: bytes | memoryview) -> Any:
    """Return the value of :func:`encode`'s bytes. Arrays are writable copies.

    Raises:
        ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError, HybridLioError: the bytes are no such
            value.
    """
    view = memoryview(data)
    (length,) = _LENGTHS.unpack(view[: _LENGTHS.size])
    tree = json.loads(bytes(view[_LENGTHS.size : _LENGTHS.size + length]))
    return _Reader(view[_LENGTHS.size + length :], *tree[1:]).value(tree[0])


def state_of(source: object) -> dict[str, Any]:
    """Return an object's attributes, without those that its class lists in ``NOT_STATE``, such as loaded weights."""
    omitted = getattr(type(source), "NOT_STATE", ())
    return {name: value for name, value in vars(source).items() if name not in omitted}


def restore(target: object, state: Mapping[str, Any]) -> None:
    """Set the attributes of an object as :func:`state_of` returned them. Objects inside it are restored in place.

    Raises:
        DataError: one is missing, or hybridlio's own class does not know it, as in the state of another version.
    """
    expected = set(state_of(target))
    found = set(state) if _is_own(type(target)) else expected & set(state)  # a user's class may add attributes later
    check_names(found, expected, type(target).__name__)
    for name, value in state.items():
        current = getattr(target, name, None)
        if type(current) is type(value) and _is_own(type(value)) and not dataclasses.is_dataclass(value):
            restore(current, vars(value))
        else:
            setattr(target, name, value)


def check_names(found: Iterable[str], expected: Iterable[str], what: str) -> None:
    """Raise a DataError unless stored values have exactly the expected names."""
    found, expected = set(found), set(expected)
    if found != expected:
        faults = [f"{name!r} is missing" for name in sorted(expected - found)]
        faults += [f"{name!r} is not known" for name in sorted(found - expected)]
        raise DataError(f"{what}: {', '.join(faults)}")


def _is_own(kind: type) -> bool:
    return kind.__module__.startswith(_PACKAGE)


class _Writer:
    """Turns a value into a tree for JSON and the data of its arrays. An object met twice is written once."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.layouts: dict[tuple[str, tuple[int, ...], str], int] = {}  # that occur, numbered
        self.kinds: list[int] = []  # number of each array's layout
        self.classes: dict[str, int] = {}  # that occur, numbered
        self._places: dict[int, int] = {}  # of the objects written, by id
        self._alive: list[Any] = []  # so that no id is used twice

    def node(self, value: Any) -> Any:
        kind = type(value)
        if kind in _PLAIN:
            return value
        if kind is dict:
            if all(type(key) is str for key in value):
                return {key: self.node(one) for key, one in value.items()}
            return ["d", *([self.node(key), self.node(one)] for key, one in value.items())]
        if kind is list or kind is tuple:
            return [kind.__name__[0], *map(self.node, value)]
        if id(value) in self._places:
            return ["r", self._places[id(value)]]
        out = self._object(kind, value)
        self._places[id(value)] = len(self._alive)
        self._alive.append(value)
        return out

    def _object(self, kind: type, value: Any) -> list[Any]:
        if kind is np.ndarray:
            return ["a", self._store(value)]
        if kind is bytes:
            return ["b", self._store(np.frombuffer(value, np.uint8))]
        if isinstance(value, np.generic):
            return ["n", self._store(np.asarray(value))]
        if _is_own(kind):
            return ["o", self._number(kind), self.node(_attributes(value))]
        for name, (foreign, to_plain, _) in _foreign.items():
            if isinstance(value, foreign):
                return ["f", name, self.node(to_plain(value))]
        raise TypeError(f"objects of {kind.__module__}.{kind.__qualname__} cannot be stored")

    def _store(self, array: np.ndarray[Any, Any]) -> int:
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"arrays of {array.dtype} cannot be stored")
        order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        self.data.append(array.tobytes(order))
        self.kinds.append(self.layouts.setdefault((array.dtype.str, array.shape, order), len(self.layouts)))
        return len(self.data) - 1

    def _number(self, kind: type) -> int:
        name = f"{kind.__module__}:{kind.__qualname__}"
        return self.classes.setdefault(name, len(self.classes))


def _attributes(value: Any) -> Any:
    if hasattr(value, "_fields"):  # a named tuple
        return list(value)
    if dataclasses.is_dataclass(value):
        return {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
    if "__getstate__" in vars(type(value)):
        return value.__getstate__()
    return state_of(value)


class _Reader:
    """Makes the value from its tree and data."""

    def __init__(self, data: memoryview, layouts: list[list[Any]], kinds: list[int], classes: list[str]) -> None:
        self._classes = [_find(name) for name in classes]
        self._arrays: list[np.ndarray[Any, Any]] = []
        self._made: list[Any] = []
        start = 0
        for number in kinds:
            kind, shape, order = layouts[number]
            dtype = np.dtype(kind)
            if dtype.kind not in _KINDS or any(length < 0 for length in shape):
                raise TypeError(f"arrays of {dtype} with shape {shape} cannot be stored")
            size = int(np.prod(shape, dtype=object)) * dtype.itemsize  # of Python integers, which do not overflow
            array = np.frombuffer(data[start : start + size], dtype).reshape(shape, order=order)
            self._arrays.append(array.copy(order))
            start += size

    def value(self, node: Any) -> Any:
        if isinstance(node, dict):
            return {key: self.value(one) for key, one in node.items()}
        if not isinstance(node, list):
            return node
        tag, *parts = node
        if tag == "d":
            return {self.value(key): self.value(one) for key, one in parts}
        if tag == "l":
            return [self.value(part) for part in parts]
        if tag == "t":
            return tuple(self.value(part) for part in parts)
        if tag == "r":
            return self._made[parts[0]]
        made = self._object(tag, *parts)
        self._made.append(made)
        return made

    def _object(self, tag: str, key: Any, content: Any = None) -> Any:
        if tag == "o":
            return _made(self._classes[key], self.value(content))
        if tag == "f":
            return _foreign[key][2](self.value(content))
        array = self._arrays[key]
        return {"a": lambda: array, "b": array.tobytes, "n": lambda: array[()]}[tag]()


def _find(name: str) -> type:
    """Return the class of hybridlio with this name, as ``module:class``."""
    module, _, path = name.partition(":")
    if not module.startswith(_PACKAGE):
        raise TypeError(f"{name} is no class of hybridlio")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type) or found.__module__ != module:
        raise TypeError(f"{name} is no class of hybridlio")
    return found


def _made(kind: Any, attributes: Any) -> Any:
    if hasattr(kind, "_fields"):
        return kind(*attributes)
    if dataclasses.is_dataclass(kind):  # a default is for callers; where a value was stored, none is right but its own
        check_names(attributes, [one.name for one in dataclasses.fields(kind)], cast("type", kind).__name__)
        return cast("Callable[..., Any]", kind)(**attributes)
    made = kind.__new__(kind)
    if "__setstate__" in vars(kind):
        made.__setstate__(attributes)
    else:
        check_names(attributes, _assigned(kind), kind.__name__)
        vars(made).update(attributes)
    return made


@cache
def _assigned(kind: type) -> frozenset[str]:
    """Return the names of the attributes that a class's constructor assigns, without those that are no state."""
    constructor = cast("Any", kind).__init__
    stored = (one.argval for one in dis.get_instructions(constructor) if one.opname == "STORE_ATTR")
    return frozenset(stored) - set(getattr(kind, "NOT_STATE", ()))
