"""Implementations of the three seams by name.

To add one, write one function here that makes it from a :class:`~hybridlio.odometry.setup.Setup`, and one line in
:data:`INITIAL_POSE_SOURCES`, :data:`RESIDUAL_SOURCES` or :data:`BACKENDS`, with its name in
:mod:`hybridlio.odometry.names`. The command line then offers the name, and
the contract tests run on it. Import the implementation inside the function: only what a run uses gets loaded, and the
command line stays quick.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.odometry import names

if TYPE_CHECKING:  # the command line imports this module for the names
    from hybridlio.cloud.preparation import PreparationOptions
    from hybridlio.core.estimates import Backend, InitialPoseSource, ResidualSource
    from hybridlio.learned.settings import Recipe
    from hybridlio.learned.sources.network_residual import NetworkResidual
    from hybridlio.odometry.config import Config
    from hybridlio.odometry.setup import Setup
    from hybridlio.sources.recent_scans import PairSource


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
    if settings.target == "local-map":  # it holds several earlier scans already
        return ScanMatching(settings)
    return _with_recent_scans(ScanMatching(settings), setup)


def _network(setup: Setup) -> ResidualSource:
    return _with_recent_scans(_network_alone(setup), setup)


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


def make_implementations(chosen: Chosen, setup: Setup) -> tuple[InitialPoseSource, ResidualSource, Backend]:
    """Make the implementations that are given by name; pass on those that are given as objects.

    Raises:
        ConfigError: one cannot be made with its settings, for instance because its weights are missing.
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


def check_implementations(config: Config) -> None:
    """Check, without a recording, that the configuration's three implementations can be made.

    Raises:
        ConfigError: a name is unknown, or an implementation cannot be made with its settings.
    """
    from hybridlio.core.sensors import Calibration, ImuNoise
    from hybridlio.odometry.setup import Setup

    chosen = (config.initial_pose, config.residual, config.backend)
    check_names(*chosen)
    make_implementations(chosen, Setup(config, Calibration(), config.imu_noise or ImuNoise()))


def check_names(initial_pose: object, residual: object, backend: object) -> None:
    """Check the implementations that are given by name; accept those that are given as objects.

    Raises:
        ConfigError: a name is unknown; the message lists the known ones.
    """
    names.check_name("initial pose", initial_pose, names.INITIAL_POSES)
    names.check_name("residual", residual, names.RESIDUALS)
    names.check_name("backend", backend, names.BACKENDS)


def preparation_for(recipe: Recipe) -> PreparationOptions:
    """Return how scans are prepared for the network and the loss of a recipe."""
    from hybridlio.cloud.preparation import PreparationOptions

    loss = recipe.loss
    return PreparationOptions(
        geometry=recipe.network.geometry, remove_ground=not loss.keep_ground, normal_thin_m=loss.normal_thin_m
    )


def _network_alone(setup: Setup) -> NetworkResidual:
    from hybridlio.cloud.preparation import prepare
    from hybridlio.learned.sources.network_residual import NetworkResidual

    return NetworkResidual(lambda recipe: partial(prepare, options=preparation_for(recipe)), setup.config.network)


def _with_recent_scans(source: PairSource, setup: Setup) -> ResidualSource:
    from hybridlio.sources.recent_scans import WithRecentScans

    return WithRecentScans(source, setup.config.recent_scans) if setup.config.recent_scans.count else source
