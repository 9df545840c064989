"""Factor graphs; no other package imports GTSAM."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridlio.graph.base.kernels import KERNELS as KERNELS
    from hybridlio.graph.calibration.estimates import CalibrationEstimate as CalibrationEstimate
    from hybridlio.graph.formats.load_report import LoadReport as LoadReport
    from hybridlio.graph.model.calibrations import CALIBRATION_KINDS as CALIBRATION_KINDS
    from hybridlio.graph.pose_graph import PoseGraph as PoseGraph
    from hybridlio.graph.solve.online_solver import OnlineSolver as OnlineSolver
    from hybridlio.graph.solve.solution import Solution as Solution

__all__ = [
    "CALIBRATION_KINDS", "KERNELS", "CalibrationEstimate", "LoadReport", "OnlineSolver", "PoseGraph", "Solution",
]  # fmt: skip

_MODULES = {
    "CALIBRATION_KINDS": "hybridlio.graph.model.calibrations",
    "CalibrationEstimate": "hybridlio.graph.calibration.estimates",
    "KERNELS": "hybridlio.graph.base.kernels",
    "LoadReport": "hybridlio.graph.formats.load_report",
    "OnlineSolver": "hybridlio.graph.solve.online_solver",
    "PoseGraph": "hybridlio.graph.pose_graph",
    "Solution": "hybridlio.graph.solve.solution",
}


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_MODULES[name]), name)
