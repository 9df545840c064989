"""Settings of the solvers of a pose graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hybridlio.core.errors import ConfigError

SolverName: TypeAlias = Literal["auto", "batch", "gnc", "incremental", "fixed-lag"]
OnlineName: TypeAlias = Literal["incremental", "fixed-lag"]
InitialMethod: TypeAlias = Literal["odometry", "spanning-tree", "chordal"]
InitialName: TypeAlias = Literal["auto", "given"] | InitialMethod

IterationProgress: TypeAlias = Callable[[str, int, float], None]  # stage, iteration, error
TOLERANCE = 1e-6  # of the error: poses then lie within a few thousandths of a standard deviation

SOLVERS = ("auto", "batch", "gnc", "incremental", "fixed-lag")
ONLINE_SOLVERS = ("incremental", "fixed-lag")
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
        if self.backend not in SOLVERS:
            raise ConfigError(f"unknown backend {self.backend!r}; choose one of {', '.join(SOLVERS)}")
        if self.initial not in INITIAL:
            raise ConfigError(f"unknown initial={self.initial!r}; choose one of {', '.join(INITIAL)}")
        if self.max_iterations < 1 or not self.tolerance > 0 or self.lag < 1:
            raise ConfigError(
                "max_iterations, tolerance and lag must be positive, "
                f"got {self.max_iterations}, {self.tolerance} and {self.lag}"
            )


def silent(stage: str, iteration: int, error: float) -> None:
    """Ignore progress."""
    del stage, iteration, error
