"""The three seams' implementations by name. A new one is one entry here; contract tests run on every entry.

Each is made when it is asked for, so that only what is used is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

from hybridlio.core.errors import ConfigError, DataError

if TYPE_CHECKING:  # the command line lists the names, and must start quickly
    from hybridlio.cloud.preparation import PreparationOptions
    from hybridlio.core.estimates import Backend, InitialPoseSource, ResidualSource
    from hybridlio.core.sensors import Calibration, ImuNoise
    from hybridlio.graph.run.inertial_steps import InertialSteps
    from hybridlio.learned.settings import Recipe
    from hybridlio.learned.sources.network_residual import NetworkResidual
    from hybridlio.odometry.config import Config
    from hybridlio.sources.recent_scans import PairSource


@dataclass(frozen=True, eq=False)
class Setup:
    """What an implementation may need to know when it is made."""

    config: Config
    calibration: Calibration
    imu_noise: ImuNoise

    @cached_property
    def inertial_steps(self) -> InertialSteps:
        """One for all, so that each step's samples are summed up once."""
        from hybridlio.graph.run.inertial_steps import InertialSteps

        return InertialSteps(self.calibration, self.imu_noise)


def _preintegration(setup: Setup) -> InitialPoseSource:
    from hybridlio.graph.run.inertial_initial_pose import Preintegration

    return Preintegration(setup.inertial_steps)


def _kalman(setup: Setup) -> InitialPoseSource:
    from hybridlio.sources.kalman import Kalman

    return Kalman(setup.calibration, setup.imu_noise)


def _constant_velocity(_: Setup) -> InitialPoseSource:
    from hybridlio.sources.constant_velocity import ConstantVelocity

    return ConstantVelocity()


def _identity(_: Setup) -> InitialPoseSource:
    from hybridlio.sources.constant_velocity import Identity

    return Identity()


def _lstm(setup: Setup) -> InitialPoseSource:
    from hybridlio.learned.sources.lstm_initial_pose import LstmInitialPose

    return LstmInitialPose(setup.config.lstm)


def _scan_matching(setup: Setup) -> ResidualSource:
    from hybridlio.sources.scan_matching import ScanMatching

    settings = setup.config.scan_matching
    if settings.target == "local-map":  # it is made of the keyframes
        return ScanMatching(settings)
    return _with_recent_scans(ScanMatching(settings), setup)


def _network_alone(setup: Setup) -> NetworkResidual:
    from hybridlio.cloud.preparation import prepare
    from hybridlio.learned.sources.network_residual import NetworkResidual

    return NetworkResidual(lambda recipe: partial(prepare, options=preparation_for(recipe)), setup.config.network)


def _network(setup: Setup) -> ResidualSource:
    return _with_recent_scans(_network_alone(setup), setup)


def _with_recent_scans(source: PairSource, setup: Setup) -> ResidualSource:
    from hybridlio.sources.recent_scans import WithRecentScans

    return WithRecentScans(source, setup.config.recent_scans) if setup.config.recent_scans.count else source


def _network_then_scan_matching(setup: Setup) -> ResidualSource:
    from hybridlio.sources.residual_chain import ResidualChain

    return ResidualChain(_network_alone(setup), _scan_matching(setup))


def _no_residual(_: Setup) -> ResidualSource:
    from hybridlio.sources.residual_chain import NoResidual

    return NoResidual()


def _incremental(setup: Setup) -> Backend:
    from hybridlio.graph.run.isam_backend import IncrementalBackend

    return IncrementalBackend(setup.inertial_steps)


def _fixed_lag(setup: Setup) -> Backend:
    from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend

    return FixedLagBackend(setup.inertial_steps)


def _no_backend(setup: Setup) -> Backend:
    from hybridlio.sources.dead_reckoning import DeadReckoning

    return DeadReckoning(setup.calibration)


INITIAL_POSE_SOURCES: dict[str, Callable[[Setup], InitialPoseSource]] = {
    "preintegration": _preintegration,
    "lstm": _lstm,
    "kalman": _kalman,
    "constant-velocity": _constant_velocity,
    "identity": _identity,
}
RESIDUAL_SOURCES: dict[str, Callable[[Setup], ResidualSource]] = {
    "scan-matching": _scan_matching,
    "network": _network,
    "network+scan-matching": _network_then_scan_matching,
    "none": _no_residual,
}
BACKENDS: dict[str, Callable[[Setup], Backend]] = {
    "incremental": _incremental,
    "fixed-lag": _fixed_lag,
    "none": _no_backend,
}


Chosen = tuple["str | InitialPoseSource", "str | ResidualSource", "str | Backend"]


def make_chosen(chosen: Chosen, setup: Setup) -> tuple[InitialPoseSource, ResidualSource, Backend]:
    """Make those of the three that are names; objects are taken as they are.

    Raises:
        ConfigError: one cannot be made as it is set, such as for want of its weights.
    """
    initial_pose, residual, backend = chosen
    try:
        return (
            INITIAL_POSE_SOURCES[initial_pose](setup) if isinstance(initial_pose, str) else initial_pose,
            RESIDUAL_SOURCES[residual](setup) if isinstance(residual, str) else residual,
            BACKENDS[backend](setup) if isinstance(backend, str) else backend,
        )
    except DataError as error:
        raise ConfigError(str(error)) from error


def check_made(config: Config) -> None:
    """Check, without a recording, that the three can be made as they are set.

    Raises:
        ConfigError: there is no implementation of a name, or it cannot be made.
    """
    from hybridlio.core.sensors import Calibration, ImuNoise

    chosen = (config.initial_pose, config.residual, config.backend)
    check_names(*chosen)
    make_chosen(chosen, Setup(config, Calibration(), config.imu_noise or ImuNoise()))


def check_names(initial_pose: object, residual: object, backend: object) -> None:
    """Check those of the three that are names; objects are taken as they are.

    Raises:
        ConfigError: there is no implementation of that name; lists those there are.
    """
    seams: tuple[tuple[str, object, Iterable[str]], ...] = (
        ("initial pose", initial_pose, INITIAL_POSE_SOURCES),
        ("residual", residual, RESIDUAL_SOURCES),
        ("backend", backend, BACKENDS),
    )
    for kind, choice, known in seams:
        if isinstance(choice, str) and choice not in known:
            raise ConfigError(f"unknown {kind} {choice!r}; choose one of {', '.join(known)}")


def preparation_for(recipe: Recipe) -> PreparationOptions:
    """How scans are prepared for a network and its loss."""
    from hybridlio.cloud.preparation import PreparationOptions

    loss = recipe.loss
    return PreparationOptions(
        geometry=recipe.network.geometry, remove_ground=not loss.keep_ground, normal_thin_m=loss.normal_thin_m
    )
