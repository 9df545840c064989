"""Settings of the solvers of a pose graph."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hybridlio.core.errors import ConfigError, shown
from hybridlio.graph.model.noise import is_positive

SolverName: TypeAlias = Literal["auto", "batch", "gnc", "incremental", "fixed-lag"]
OnlineName: TypeAlias = Literal["incremental", "fixed-lag"]
OutlierTest: TypeAlias = Literal["chi2", "gnc"]
InitialMethod: TypeAlias = Literal["odometry", "spanning-tree", "chordal"]
InitialName: TypeAlias = Literal["auto", "given"] | InitialMethod

IterationProgress: TypeAlias = Callable[[str, int, float], None]  # stage, iteration, error
TOLERANCE = 1e-6  # of the error: poses then lie within a few thousandths of a standard deviation

SOLVERS = ("auto", "batch", "gnc", "incremental", "fixed-lag")
ONLINE_SOLVERS = ("incremental", "fixed-lag")
OUTLIER_TESTS = ("chi2", "gnc")
INITIAL_METHODS: tuple[InitialMethod, ...] = ("odometry", "spanning-tree", "chordal")
INITIAL = ("auto", "given", *INITIAL_METHODS)


@dataclass(frozen=True)
class Settings:
    """Arguments of :meth:`hybridlio.graph.pose_graph.PoseGraph.optimize`.

    Raises:
        ConfigError: an unknown name, or a number that is not positive.
    """

    backend: str
    initial: str
    max_iterations: int
    tolerance: float
    lag: int

    def __post_init__(self) -> None:
        check_choice("backend", self.backend, SOLVERS)
        check_choice("initial", self.initial, INITIAL)
        check_count("max_iterations", self.max_iterations)
        check_count("lag", self.lag)
        if not is_positive(self.tolerance):
            raise ConfigError(f"tolerance must be positive, got {shown(self.tolerance)}")


def check_choice(what: str, value: object, choices: Collection[str]) -> None:
    """Raise ConfigError where a value is none of the names to choose from."""
    if not isinstance(value, str) or value not in choices:
        raise ConfigError(f"unknown {what} {shown(value)}; choose one of {', '.join(choices)}")


def check_count(what: str, value: object) -> None:
    """Raise ConfigError where a value is no positive integer that fits 32 bits, as GTSAM's numbers do."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not 0 < value < 1 << 31:
        raise ConfigError(f"{what} must be a positive integer below 2**31, got {shown(value)}")


def silent(stage: str, iteration: int, error: float) -> None:
    """Ignore progress."""
    del stage, iteration, error
