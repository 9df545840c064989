"""What settings may be: each checks itself, so that an error says the same from Python and from a file."""

from __future__ import annotations

from collections.abc import Callable

from hybridlio.core.errors import ConfigError


class SettingError(ConfigError, ValueError):
    """A setting's value is not one that it can have. A ValueError too, for pydantic to add where in a file it stands.

    Args:
        owner: name of the settings' type.
        name: of the setting.
        complaint: what is wrong with it.
    """

    def __init__(self, owner: str, name: str, complaint: str) -> None:
        super().__init__(owner, name, complaint)
        self.name, self.complaint = name, complaint

    def __str__(self) -> str:
        return "{}.{}: {}".format(*self.args)


def above_0(settings: object, *names: str) -> None:
    """Check that some of the settings' numbers are above 0; NaN is not.

    Raises:
        SettingError: names the first that is not.
    """
    _each(settings, names, lambda value: value > 0, "above 0")


def from_0(settings: object, *names: str) -> None:
    """Check that some of the settings' numbers are 0 or more, as :func:`above_0` does."""
    _each(settings, names, lambda value: value >= 0, "0 or more")


def shares(settings: object, *names: str) -> None:
    """Check that some of the settings' numbers are within 0 and 1, as :func:`above_0` does."""
    _each(settings, names, lambda value: 0 <= value <= 1, "within 0 and 1")


def expect(settings: object, name: str, holds: bool, wanted: str) -> None:
    """Check one of the settings against what is known of it; ``wanted`` goes behind "must be".

    Raises:
        SettingError: it does not hold.
    """
    if not holds:
        raise SettingError(type(settings).__name__, name, f"must be {wanted}, got {getattr(settings, name)}")


def _each(settings: object, names: tuple[str, ...], holds: Callable[[float], bool], wanted: str) -> None:
    for name in names:
        expect(settings, name, holds(getattr(settings, name)), wanted)
