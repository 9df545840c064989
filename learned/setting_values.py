"""Settings as plain values, for JSON, YAML and the metadata of weights, and back."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

from hybridlio.core.errors import ConfigError

_S = TypeVar("_S")


def to_dict(settings: Any) -> dict[str, Any]:
    """Return settings as plain values for JSON; infinity becomes ``"inf"``."""
    values = dataclasses.asdict(settings)
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return list(value)
    return "inf" if value == float("inf") else value


def from_dict(kind: type[_S], values: Mapping[str, Any], where: str = "settings") -> _S:
    """Return settings of a class from plain values.

    Args:
        kind: the class.
        values: by name of the field.
        where: path of these values in their file, for messages.

    Raises:
        ConfigError: a key is unknown or missing, or a value has the wrong type or is out of range; names the key.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected named values, got {type(values).__name__}")
    hints = typing.get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind)]  # type: ignore[arg-type]
    unknown = [key for key in values if key not in known]
    if unknown:
        raise ConfigError(f"{where}: unknown key {', '.join(map(repr, unknown))}; known keys are {', '.join(known)}")
    required = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]  # type: ignore[arg-type]
    missing = [name for name in required if name not in values]
    if missing:
        raise ConfigError(f"{where}: missing key {', '.join(map(repr, missing))}")
    return kind(**{key: _typed(hints[key], value, f"{where}.{key}") for key, value in values.items()})


def _typed(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast("type[Any]", hint), value, where)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where}: expected a list, got {value!r}")
        return tuple(_typed(typing.get_args(hint)[0], item, where) for item in value)
    if typing.get_origin(hint) is Literal or isinstance(hint, types.UnionType):
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and (number or value == "inf"):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {value!r}")
    return value
