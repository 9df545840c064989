"""Lidar-inertial odometry that joins a learned front end with a factor graph.

Estimate the trajectory of a recording (KITTI, or a folder of scans):

    import hybridlio as hl
    odometry = hl.Odometry(initial_pose="preintegration", residual="scan-matching")
    estimates = [odometry.step(frame) for frame in hl.open_sequence("2011_09_26_drive_0005_sync")]

Recordings:
    open_sequence      open a recording; find_recordings finds those below a folder
    calibrate          find its extrinsics and clocks, with standard deviations
    check_recording    compare its IMU with its scans: clocks, units and mounting, corrected or named
    Sequence           a recording: one Frame per scan, with its Scan, ImuSamples and GpsFix objects
    simulate           simulate a drive as KITTI raw data; SimulationConfig has its settings

Estimation:
    Odometry           estimates frame by frame; Config has its settings, load_config reads them from a YAML file
    OdometryStream     the same from live data, such as in a robot's node: measurements in, estimates out
    Estimate           the result of a step: pose, covariance and what they were computed from
    smooth             smooth a finished run (odometry.record()) over its whole length, with loops and GPS
    localize           where a recording is in a prior map: a run folder or a map file
    merge              join the records of several runs by the places that they share, into one world
    run_batch          run many Recordings in parallel; BatchOptions has the settings, Batch the results

Results:
    build_map          map of a run: its scans as one cloud, without moving objects; MapSettings has the settings
    export_mcap        write a run as an MCAP file for Foxglove
    view               show a run in the Rerun viewer, or write a file for it
    Trajectory         stamped lidar poses with covariances
    evaluate           drift, ATE, RPE and consistency against a reference

Your own sources:
    RelativePose       what a source returns; hybridlio.core.estimates has the protocols
    State              what the backend returns
    Calibration        extrinsics; ImuNoise has the IMU's noise densities

Poses are float64 (4, 4) arrays, T_a_b maps points of frame b into frame a. Covariances are (6, 6), rotation first, rad²
and m². Time is int64 nanoseconds. Errors descend from HybridLioError. Pose graphs are in hybridlio.graph (PoseGraph).
"""

from importlib import import_module
from typing import TYPE_CHECKING

from hybridlio.core.version import __version__

if TYPE_CHECKING:  # what type checkers and editors see; at run time each name loads when first used
    from hybridlio.core.errors import HybridLioError
    from hybridlio.core.estimates import RelativePose, State
    from hybridlio.core.sensors import Calibration, Frame, GpsFix, ImuNoise, ImuSamples, Scan
    from hybridlio.core.trajectory import Trajectory
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.datasets.sequence import Sequence
    from hybridlio.evaluation.evaluate import evaluate
    from hybridlio.graph.run.smooth import smooth
    from hybridlio.localization.localize import localize
    from hybridlio.localization.merge import merge
    from hybridlio.mapping.build import build_map
    from hybridlio.mapping.settings import MapSettings
    from hybridlio.odometry.config import Config, load_config
    from hybridlio.odometry.estimate import Estimate
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.odometry.stream import OdometryStream
    from hybridlio.runs.batch import BatchOptions, run_batch
    from hybridlio.runs.batch_table import Batch
    from hybridlio.runs.calibrate import calibrate
    from hybridlio.runs.recording_check import check_recording
    from hybridlio.runs.recordings import Recording, find_recordings
    from hybridlio.simulation.config import SimulationConfig
    from hybridlio.simulation.simulate import simulate
    from hybridlio.viewing.mcap_export import export_mcap
    from hybridlio.viewing.view import view

__all__ = [
    "Batch",
    "BatchOptions",
    "Calibration",
    "Config",
    "Estimate",
    "Frame",
    "GpsFix",
    "HybridLioError",
    "ImuNoise",
    "ImuSamples",
    "MapSettings",
    "Odometry",
    "OdometryStream",
    "Recording",
    "RelativePose",
    "Scan",
    "Sequence",
    "SimulationConfig",
    "State",
    "Trajectory",
    "__version__",
    "build_map",
    "calibrate",
    "check_recording",
    "evaluate",
    "export_mcap",
    "find_recordings",
    "load_config",
    "localize",
    "merge",
    "open_sequence",
    "run_batch",
    "simulate",
    "smooth",
    "view",
]

_HOMES = {
    "core.errors": ("HybridLioError",),
    "core.estimates": ("RelativePose", "State"),
    "core.sensors": ("Calibration", "Frame", "GpsFix", "ImuNoise", "ImuSamples", "Scan"),
    "core.trajectory": ("Trajectory",),
    "datasets.registry": ("open_sequence",),
    "datasets.sequence": ("Sequence",),
    "evaluation.evaluate": ("evaluate",),
    "graph.run.smooth": ("smooth",),
    "localization.localize": ("localize",),
    "localization.merge": ("merge",),
    "mapping.build": ("build_map",),
    "mapping.settings": ("MapSettings",),
    "odometry.config": ("Config", "load_config"),
    "odometry.estimate": ("Estimate",),
    "odometry.odometry": ("Odometry",),
    "odometry.stream": ("OdometryStream",),
    "runs.batch": ("BatchOptions", "run_batch"),
    "runs.batch_table": ("Batch",),
    "runs.calibrate": ("calibrate",),
    "runs.recording_check": ("check_recording",),
    "runs.recordings": ("Recording", "find_recordings"),
    "simulation.config": ("SimulationConfig",),
    "simulation.simulate": ("simulate",),
    "viewing.mcap_export": ("export_mcap",),
    "viewing.view": ("view",),
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
