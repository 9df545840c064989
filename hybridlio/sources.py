"""The three seams' implementations by name. A new one is one entry here; contract tests run on every entry.

Each is made when it is asked for, so that only what is used is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from hybridlio.config import Config
from hybridlio.errors import ConfigError
from hybridlio.estimates import Backend, InitialPoseSource, ResidualSource
from hybridlio.sensors import Calibration, ImuNoise


@dataclass(frozen=True, eq=False)
class Setup:
    """What an implementation may need to know when it is made."""

    config: Config
    calibration: Calibration
    imu_noise: ImuNoise


def _preintegration(setup: Setup) -> InitialPoseSource:
    from hybridlio.graph.preintegration import Preintegration

    return Preintegration(setup.calibration, setup.imu_noise)


def _kalman(setup: Setup) -> InitialPoseSource:
    from hybridlio.kalman import Kalman

    return Kalman(setup.calibration, setup.imu_noise)


def _constant_velocity(setup: Setup) -> InitialPoseSource:
    from hybridlio.initial_pose import ConstantVelocity

    return ConstantVelocity()


def _identity(setup: Setup) -> InitialPoseSource:
    from hybridlio.initial_pose import Identity

    return Identity()


def _scan_matching(setup: Setup) -> ResidualSource:
    from hybridlio.scan_matching import ScanMatching

    return ScanMatching(setup.config.scan_matching)


def _no_residual(setup: Setup) -> ResidualSource:
    from hybridlio.initial_pose import NoResidual

    return NoResidual()


def _incremental(setup: Setup) -> Backend:
    from hybridlio.graph.online import IncrementalBackend

    return IncrementalBackend(setup.calibration, setup.imu_noise)


INITIAL_POSE_SOURCES: dict[str, Callable[[Setup], InitialPoseSource]] = {
    "preintegration": _preintegration,
    "kalman": _kalman,
    "constant-velocity": _constant_velocity,
    "identity": _identity,
}
RESIDUAL_SOURCES: dict[str, Callable[[Setup], ResidualSource]] = {
    "scan-matching": _scan_matching,
    "none": _no_residual,
}
BACKENDS: dict[str, Callable[[Setup], Backend]] = {
    "incremental": _incremental,
}

_T = TypeVar("_T")


def choose(kind: str, name: str, known: Mapping[str, _T]) -> _T:
    """The implementation of a seam by name.

    Raises:
        ConfigError: there is none of that name; lists those there are.
    """
    if name not in known:
        raise ConfigError(f"unknown {kind} {name!r}; choose one of {', '.join(known)}")
    return known[name]
