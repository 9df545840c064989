"""The simulated world: a town, a road, a lidar and an IMU that agree with each other exactly."""

from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.simulate import simulate

__all__ = ["SimulationConfig", "simulate"]
