"""Options about the odometry of another system, and what was measured beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_OF_POSES = "With --poses: "

Poses = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Poses of any odometry in place of RUN: a TUM, KITTI or EuRoC file.")
]
StampsFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help=f"{_OF_POSES}stamps in seconds, a line a pose, for KITTI's files.")
]
ImuFile = Annotated[Path | None, typer.Option(metavar="CSV", help=f"{_OF_POSES}raw samples of the IMU.")]
CalibrationFile = Annotated[
    Path | None, typer.Option(metavar="YAML", help=f"{_OF_POSES}T_imu_lidar, antenna_imu_m, imu_noise and more.")
]
Reference = Annotated[Path | None, typer.Option(metavar="FILE", help=f"{_OF_POSES}ground truth to evaluate against.")]
Wheels = Annotated[Path | None, typer.Option(metavar="CSV", help="Wheel speeds: stamp_ns or t_s, vx, or vx, vy, vz.")]
Sideways = Annotated[
    float | None,
    typer.Option(metavar="M_S", help="Of --wheels that hardly slip: standard deviation of the speed sideways and up."),
]
