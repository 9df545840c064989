"""Range checks that settings classes run on construction, so that Python and YAML users see the same error."""

from __future__ import annotations

from collections.abc import Callable

from hybridlio.core.errors import ConfigError


class SettingError(ConfigError, ValueError):
    """A setting has a value that is out of range.

    It is also a ``ValueError``, because pydantic wraps only those and adds the setting's path in the file.

    Args:
        owner: name of the settings class.
        name: name of the setting.
        complaint: what is wrong, such as "must be above 0, got -1".
    """

    def __init__(self, owner: str, name: str, complaint: str) -> None:
        super().__init__(owner, name, complaint)
        self.name, self.complaint = name, complaint

    def __str__(self) -> str:
        return "{}.{}: {}".format(*self.args)


def check_positive(settings: object, *names: str) -> None:
    """Check that the named settings are above 0; NaN is not.

    Raises:
        SettingError: names the first setting that is not.
    """
    _check_each(settings, names, lambda value: value > 0, "above 0")


def check_not_negative(settings: object, *names: str) -> None:
    """Check that the named settings are 0 or more; NaN is not.

    Raises:
        SettingError: names the first setting that is not.
    """
    _check_each(settings, names, lambda value: value >= 0, "0 or more")


def check_fraction(settings: object, *names: str) -> None:
    """Check that the named settings are between 0 and 1, both included.

    Raises:
        SettingError: names the first setting that is not.
    """
    _check_each(settings, names, lambda value: 0 <= value <= 1, "between 0 and 1")


def check_setting(settings: object, name: str, holds: bool, requirement: str) -> None:
    """Raise an error unless a condition on one setting holds.

    Args:
        settings: the settings object.
        name: name of the setting.
        holds: whether its value is allowed.
        requirement: continues "must be" in the message, such as "above 0".

    Raises:
        SettingError: the condition does not hold.
    """
    if not holds:
        raise SettingError(type(settings).__name__, name, f"must be {requirement}, got {getattr(settings, name)}")


def _check_each(
    settings: object, names: tuple[str, ...], is_allowed: Callable[[float], bool], requirement: str
) -> None:
    for name in names:
        check_setting(settings, name, is_allowed(getattr(settings, name)), requirement)
