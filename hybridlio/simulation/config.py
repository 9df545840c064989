"""What a simulated drive is made of: one frozen tree of settings."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import LIDAR_MODELS, ImuNoise, LidarModel

Scene = Literal["town", "corridor", "field"]
Driving = Literal["calm", "hard"]


class SimulationConfig(BaseModel):
    """Settings of a simulated drive; the same settings give the same bytes.

    Attributes:
        seconds: duration, a day at most; by default 60 s, or with ``poses`` the whole file.
        length_m: drive this far instead of for ``seconds``.
        seed: decides road, world, noise; drives of other seeds share nothing.
        speed_m_s: cruising speed; curves, junctions and stops are slower. Not used along a pose file.
        driving: ``calm``, or ``hard``: bends at 6 m/s² sideways, brakes at 7 m/s². Not used along a pose file.
        scene: ``town`` (houses, gardens, open stretches), ``corridor`` (smooth parallel walls: hardly anything says
            how far one went) or ``field`` (open ground and a few distant trees: hardly anything at all).
        lidar: a name of :data:`hybridlio.core.sensors.LIDAR_MODELS`.
        motion_distortion: the car moves during a sweep, and points carry times; else a scan is one instant.
        start_moving: begin at cruising speed instead of from two seconds of standstill.
        loops: the route comes back to streets it has been in.
        traffic_per_km: moving cars per kilometre of road.
        parked: share of parking places taken.
        gps: write GPS fixes too.
        gps_rate_hz, gps_sigma_m: how many fixes a second, and their standard deviation on each axis.
        imu_noise: what the IMU is worth.
        poses: drive along this pose file: KITTI (12 numbers a row, one every 0.1 s) or TUM (8 numbers a row).
        poses_frame: what moves in a KITTI file: the left ``camera`` (KITTI's own), or the ``lidar``. TUM files hold
            lidar poses.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    seconds: float | None = Field(default=None, gt=0.0, le=86_400.0, allow_inf_nan=False)
    length_m: float | None = Field(default=None, gt=0.0, le=1e6, allow_inf_nan=False)
    seed: int = Field(default=1, ge=0)
    speed_m_s: float = Field(default=10.0, ge=1.0, le=40.0)
    driving: Driving = "calm"
    scene: Scene = "town"
    lidar: str = "hdl-64e"
    motion_distortion: bool = False
    start_moving: bool = True
    loops: bool = False
    traffic_per_km: float = Field(default=12.0, ge=0.0, le=100.0)
    parked: float = Field(default=0.5, ge=0.0, le=1.0)
    gps: bool = False
    gps_rate_hz: float = Field(default=1.0, gt=0.0, le=10.0)
    gps_sigma_m: float = Field(default=1.0, ge=0.0)
    imu_noise: ImuNoise = ImuNoise()
    poses: Path | None = None
    poses_frame: Literal["camera", "lidar"] = "camera"

    @field_validator("lidar")
    @classmethod
    def _known_lidar(cls, name: str) -> str:
        if name not in LIDAR_MODELS:
            raise ValueError(f"unknown lidar {name!r}; choose one of {', '.join(LIDAR_MODELS)}")
        return name

    @property
    def lidar_model(self) -> LidarModel:
        """The sensor's specification."""
        return LIDAR_MODELS[self.lidar]

    def require_poses(self) -> Path:
        """The pose file.

        Raises:
            ConfigError: none is set, or there is no such file.
        """
        if self.poses is None or not self.poses.is_file():
            raise ConfigError(f"simulation: no pose file at {self.poses}; give a KITTI or TUM trajectory")
        return self.poses
