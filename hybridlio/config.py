"""The configuration: a tree that mirrors the objects it sets up; unknown keys are errors."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hybridlio.errors import ConfigError
from hybridlio.files import write_whole
from hybridlio.keyframes import KeyframeSettings
from hybridlio.learned.source_settings import LstmSettings, NetworkResidualSettings
from hybridlio.recent_scans import RecentScansSettings
from hybridlio.scan_matching import ScanMatchingSettings
from hybridlio.sensors import ImuNoise


class Config(BaseModel):
    """Everything that an odometry run can be told.

    Attributes:
        initial_pose: a name of :data:`hybridlio.sources.INITIAL_POSE_SOURCES`.
        residual: a name of :data:`hybridlio.sources.RESIDUAL_SOURCES`.
        backend: a name of :data:`hybridlio.sources.BACKENDS`.
        imu_noise: the IMU's noise; without it the recording's own, where it says so, else an industrial MEMS unit's.
        scan_matching: settings of the classical residual source.
        recent_scans: how many earlier scans each is compared with, by ``network`` and by ``scan-matching`` to the last
            scan; a local map is made of keyframes already.
        lstm: settings of the learned initial-pose source.
        network: settings of the learned residual source.
        keyframes: which clouds are kept for closing loops.
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
    keyframes: KeyframeSettings = Field(default_factory=KeyframeSettings)


def config_to_yaml(config: Config) -> str:
    """The configuration as YAML text that :func:`load_config` reads back."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def save_config(config: Config, path: Path) -> None:
    """Write the configuration as YAML."""
    write_whole(path, config_to_yaml(config))


def load_config(path: Path) -> Config:
    """Read a YAML configuration; what it leaves out keeps its default.

    Raises:
        ConfigError: no such file, not YAML, an unknown key or a value out of range; names each.
    """
    try:
        tree = yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not YAML: {error}") from error
    return parse_config(tree or {}, str(path))


def parse_config(tree: object, where: str) -> Config:
    """The configuration of a tree of plain values; ``where`` names its origin in errors.

    Raises:
        ConfigError: an unknown key or a value out of range.
    """
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg'].lower()}" for e in error.errors())
        raise ConfigError(f"{where}: {wrong}. `hybridlio config` prints all keys with their defaults") from None
    except ConfigError as error:  # settings that check themselves
        raise ConfigError(f"{where}: {error}") from None
