"""Lidar-inertial odometry that joins a learned front end with a factor graph."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what type checkers and editors see; at run time each name loads when first used
    from hybridlio.batch import run_batch
    from hybridlio.batch_table import Batch
    from hybridlio.config import Config
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.datasets.sequence import Sequence
    from hybridlio.errors import HybridLioError
    from hybridlio.estimates import RelativePose, State
    from hybridlio.graph.offline import smooth
    from hybridlio.metrics import evaluate
    from hybridlio.odometry import Estimate, Odometry
    from hybridlio.recordings import Recording, find_recordings
    from hybridlio.sensors import Calibration, Frame, GpsFix, ImuNoise, ImuSamples, Scan
    from hybridlio.simulation.config import SimulationConfig
    from hybridlio.simulation.simulate import simulate
    from hybridlio.trajectory import Trajectory

__version__ = "0.1.0"

__all__ = [
    "Batch",
    "Calibration",
    "Config",
    "Estimate",
    "Frame",
    "GpsFix",
    "HybridLioError",
    "ImuNoise",
    "ImuSamples",
    "Odometry",
    "Recording",
    "RelativePose",
    "Scan",
    "Sequence",
    "SimulationConfig",
    "State",
    "Trajectory",
    "__version__",
    "evaluate",
    "find_recordings",
    "open_sequence",
    "run_batch",
    "simulate",
    "smooth",
]

_HOMES = {
    "batch": ("run_batch",),
    "batch_table": ("Batch",),
    "config": ("Config",),
    "datasets.registry": ("open_sequence",),
    "datasets.sequence": ("Sequence",),
    "errors": ("HybridLioError",),
    "estimates": ("RelativePose", "State"),
    "graph.offline": ("smooth",),
    "metrics": ("evaluate",),
    "odometry": ("Estimate", "Odometry"),
    "recordings": ("Recording", "find_recordings"),
    "sensors": ("Calibration", "Frame", "GpsFix", "ImuNoise", "ImuSamples", "Scan"),
    "simulation.config": ("SimulationConfig",),
    "simulation.simulate": ("simulate",),
    "trajectory": ("Trajectory",),
}
_HOME_OF = {name: f"hybridlio.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name from its module (PEP 562), so that ``import hybridlio`` loads none of the heavy libraries."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'hybridlio' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
