"""The simulated world: a drive through a town, whose sensors measure one exact motion."""

from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.simulate import simulate

__all__ = ["SimulationConfig", "simulate"]
