"""Values that the shell completes, by the option that takes them; `hybridlio --install-completion` sets it up.

The names are read from where they are defined, and only when a shell asks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import get_args

Completion = Callable[[str], list[str]]


def _one_of(names: Callable[[], Iterable[str]]) -> Completion:
    """Return the completion of a name, or of the last of several names with commas between them."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        return [f"{before}{comma}{name}" for name in names() if name.startswith(last)]

    return complete


def _initial_poses() -> Iterable[str]:
    from hybridlio.odometry.names import INITIAL_POSES

    return INITIAL_POSES


def _residuals() -> Iterable[str]:
    from hybridlio.odometry.names import RESIDUALS

    return RESIDUALS


def _backends() -> Iterable[str]:
    from hybridlio.odometry.names import BACKENDS

    return BACKENDS


def _readers() -> Iterable[str]:
    from hybridlio.datasets.registry import READERS

    return READERS


def _robust_methods() -> Iterable[str]:
    from hybridlio.graph.run.robust import ROBUST_METHODS

    return ROBUST_METHODS


def _calibrated() -> Iterable[str]:
    from hybridlio.smoothing.calibration import CALIBRATED, IMU_SCALE

    return (*CALIBRATED, IMU_SCALE)


def _solvers() -> Iterable[str]:
    from hybridlio.graph.solve.settings import SOLVERS

    return SOLVERS


def _colours() -> Iterable[str]:
    from hybridlio.mapping.colours import COLOURS

    return COLOURS


def _map_formats() -> Iterable[str]:
    from hybridlio.mapping.files import FORMATS

    return [suffix.removeprefix(".") for suffix in FORMATS]


def _scenes() -> Iterable[str]:
    from hybridlio.simulation.choices import Scene
    from hybridlio.simulation.platforms.scenes.table import SCENES

    return (*get_args(Scene), *SCENES)


def _driving() -> Iterable[str]:
    from hybridlio.simulation.choices import Driving

    return get_args(Driving)


def _platforms() -> Iterable[str]:
    from hybridlio.simulation.platforms.bodies import BODIES

    return BODIES


def _lidar_models() -> Iterable[str]:
    from hybridlio.core.lidar_models import LIDAR_MODELS

    return LIDAR_MODELS


def _lidars() -> Iterable[str]:
    from hybridlio.simulation.platforms.lidars import SCANNERS

    return dict.fromkeys((*_lidar_models(), *SCANNERS))


def _imus() -> Iterable[str]:
    from hybridlio.simulation.platforms.imu_grades import IMU_GRADES

    return IMU_GRADES


def _presets() -> Iterable[str]:
    from hybridlio.learned.presets import PRESETS

    return PRESETS


def _splits() -> Iterable[str]:
    from hybridlio.learned.paper_tables import SPLITS

    return SPLITS


initial_pose, residual, backend = _one_of(_initial_poses), _one_of(_residuals), _one_of(_backends)
reader, robust_method, solver = _one_of(_readers), _one_of(_robust_methods), _one_of(_solvers)
calibrated = _one_of(_calibrated)
lidar_model, colour, map_format = _one_of(_lidar_models), _one_of(_colours), _one_of(_map_formats)
scene, driving, platform, lidar, imu = map(_one_of, (_scenes, _driving, _platforms, _lidars, _imus))
preset, split = _one_of(_presets), _one_of(_splits)
engine = _one_of(lambda: ("loky", "threading", "dask", "ray"))
poses_frame = _one_of(lambda: ("camera", "lidar"))
device = _one_of(lambda: ("auto", "cpu", "cuda"))
base = _one_of(lambda: ("paper", "published"))
