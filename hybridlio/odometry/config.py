"""The configuration: a tree of settings that mirrors the objects it configures. Unknown keys are errors."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from hybridlio.core.errors import ConfigError, shown
from hybridlio.core.files import read_yaml
from hybridlio.core.sensors import ImuNoise
from hybridlio.core.setting_checks import SettingError
from hybridlio.learned.source_settings import LstmSettings, NetworkResidualSettings
from hybridlio.odometry.names import BACKENDS, INITIAL_POSES, RESIDUALS, check_name
from hybridlio.record.loop_keyframes import LoopKeyframeSettings
from hybridlio.sources.settings import RecentScansSettings, ScanMatchingSettings

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class Config(BaseModel):
    """All settings of an odometry run.

    Attributes:
        initial_pose: a name in :data:`hybridlio.odometry.registry.INITIAL_POSE_SOURCES`.
        residual: a name in :data:`hybridlio.odometry.registry.RESIDUAL_SOURCES`.
        backend: a name in :data:`hybridlio.odometry.registry.BACKENDS`.
        imu_noise: the IMU's noise densities. By default the recording's, or those of a MEMS unit if the
            recording does not state any.
        scan_matching: settings of the classical residual source.
        recent_scans: which recent scans each scan is compared with, by ``network``, and by ``scan-matching`` with the
            target ``last-scan``. A local map holds several scans already.
        lstm: settings of the learned initial-pose source.
        network: settings of the learned residual source.
        keyframes: which clouds are kept for loop closure.

    Raises:
        ConfigError: unknown names, or values out of range; names each.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    initial_pose: str = "preintegration"
    residual: str = "scan-matching"
    backend: str = "fixed-lag"
    imu_noise: ImuNoise | None = None
    scan_matching: ScanMatchingSettings = Field(default_factory=ScanMatchingSettings)
    recent_scans: RecentScansSettings = Field(default_factory=RecentScansSettings)
    lstm: LstmSettings = Field(default_factory=LstmSettings)
    network: NetworkResidualSettings = Field(default_factory=NetworkResidualSettings)
    keyframes: LoopKeyframeSettings = Field(default_factory=LoopKeyframeSettings)

    def __init__(self, **settings: Any) -> None:
        try:
            super().__init__(**settings)
        except ValidationError as error:
            raise ConfigError("; ".join(map(_describe, error.errors()))) from None

    @field_validator("initial_pose", "residual", "backend")
    @classmethod
    def _check_name(cls, name: str, info: ValidationInfo) -> str:
        check_name(str(info.field_name).replace("_", " "), name, _SEAMS[str(info.field_name)])
        return name


_SEAMS = {"initial_pose": INITIAL_POSES, "residual": RESIDUALS, "backend": BACKENDS}
_HINT = ". `hybridlio config` prints all keys with their defaults"


def config_to_yaml(config: Config) -> str:
    """Return the configuration as YAML text for :func:`load_config`."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read a YAML configuration; settings that it leaves out keep their defaults.

    Raises:
        ConfigError: the file is missing or not YAML, or has unknown keys or values out of range; names each.
    """
    return parse_config(read_yaml(path, ConfigError) or {}, str(path))


def parse_config(tree: object, where: str) -> Config:
    """Return the configuration from a tree of plain values.

    Args:
        tree: names and values as in the YAML file.
        where: where they come from, for error messages.

    Raises:
        ConfigError: unknown keys or values out of range.
    """
    if not isinstance(tree, dict):
        raise ConfigError(f"{where}: expected keys with values, got {shown(tree)}{_HINT}")
    try:
        return Config(**{str(name): value for name, value in tree.items()})
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}{_HINT}") from None


def _describe(error: ErrorDetails) -> str:
    """Say what is wrong with one key, and which key may have been meant."""
    *above, last = map(str, error["loc"])
    path = ".".join((*above, last))
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, SettingError):  # raised by a settings class, which does not know its path in the file
        return f"{path}.{cause.name}: {cause.complaint}"
    if error["type"] == "dataclass_type":
        return f"{path}: expected keys with values, got {shown(error['input'])}"
    if error["type"] not in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{path}: {error['msg'].lower()}"
    every = [".".join(keys) for keys in _keys(Config().model_dump())]
    beside = {key.rsplit(".", 1)[-1]: key for key in every if key.split(".")[:-1] == above}
    meant = [beside[name] for name in difflib.get_close_matches(last, beside, n=1)]
    meant = meant or [key for key in every if key.rsplit(".", 1)[-1] == last]
    return f"{path}: unknown key{f' (did you mean {meant[0]}?)' if meant else ''}"


def _keys(tree: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in tree.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from _keys(value, (*above, key))
