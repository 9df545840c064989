"""Settings of a simulated drive."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hybridlio.core.errors import ConfigError
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import ImuNoise
from hybridlio.simulation.choices import Driving, Scene

SIMULATED_IMU = ImuNoise(gyro_bias_sigma_rad_s=1.0e-2, accel_bias_sigma_m_s2=1.0e-1)
"""The IMU of simulated road vehicles: the densities that are assumed by default, and biases of a trimmed MEMS unit."""


class SimulationConfig(BaseModel):
    """Settings of a simulated drive; the same settings give the same bytes.

    Attributes:
        seconds: duration, at most a day; by default 60 s, or with ``poses`` the whole file.
        length_m: length of the drive, instead of ``seconds``.
        seed: of road, world, traffic and noise.
        drive_seed: of traffic, parked cars, the driver and noise, by default ``seed``. Another one is another drive
            through the same town, whose cars have come and gone.
        speed_m_s: cruising speed; bends, junctions and stops are slower. Not used along a pose file.
        driving: ``calm``, or ``hard``: bends at 6 m/s² lateral acceleration, braking at 7 m/s². Not used along a pose
            file.
        scene: ``town`` (houses, gardens, open stretches), ``corridor`` (smooth parallel walls, which hardly constrain
            the motion along them) or ``field`` (open ground and a few distant trees, which hardly constrain any
            horizontal motion).
        lidar: a name of :data:`hybridlio.core.sensors.LIDAR_MODELS`.
        motion_distortion: let the car move during a sweep, and give every point its time; else a scan is instantaneous.
        start_moving: start at driving speed instead of standing for two seconds.
        loops: let the route return to streets it has passed.
        traffic_per_km: moving cars per kilometre of road.
        parked: share of parking places that are taken.
        rain_mm_h: rate of rain, 2.5 mm/h in light and 50 mm/h in violent rain; drops return light and weaken the rest.
        dust_per_km: clouds of dust per kilometre of the drive.
        gps: also write GPS fixes.
        gps_rate_hz, gps_sigma_m: rate of the fixes, and their standard deviation on each axis.
        imu_noise: noise densities of the IMU; may be 0.
        poses: drive along this pose file: KITTI format (12 numbers a row, 0.1 s apart) or TUM format (8 numbers a row).
        poses_frame: what the poses of a KITTI file are of: the left ``camera`` (KITTI's own files) or the ``lidar``.
            TUM files hold lidar poses.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    seconds: float | None = Field(default=None, gt=0.0, le=86_400.0, allow_inf_nan=False)
    length_m: float | None = Field(default=None, gt=0.0, le=1e6, allow_inf_nan=False)
    seed: int = Field(default=1, ge=0)
    drive_seed: int | None = Field(default=None, ge=0)
    speed_m_s: float = Field(default=10.0, ge=1.0, le=40.0)
    driving: Driving = "calm"
    scene: Scene = "town"
    lidar: str = "hdl-64e"
    motion_distortion: bool = False
    start_moving: bool = True
    loops: bool = False
    traffic_per_km: float = Field(default=12.0, ge=0.0, le=100.0)
    parked: float = Field(default=0.5, ge=0.0, le=1.0)
    rain_mm_h: float = Field(default=0.0, ge=0.0, le=300.0)
    dust_per_km: float = Field(default=0.0, ge=0.0, le=1000.0)
    gps: bool = False
    gps_rate_hz: float = Field(default=1.0, gt=0.0, le=10.0)
    gps_sigma_m: float = Field(default=1.0, ge=0.0)
    imu_noise: ImuNoise = SIMULATED_IMU
    poses: Path | None = None
    poses_frame: Literal["camera", "lidar"] = "camera"

    @field_validator("lidar")
    @classmethod
    def _known_lidar(cls, name: str) -> str:
        if name not in LIDAR_MODELS:
            raise ValueError(f"unknown lidar {name!r}; choose one of {', '.join(LIDAR_MODELS)}")
        return name

    @property
    def own_seed(self) -> int:
        """The seed of all that differs between drives through one town."""
        return self.seed if self.drive_seed is None else self.drive_seed

    @property
    def is_first_drive(self) -> bool:
        """Whether the town is as its own seed makes it; False at another drive through it."""
        return self.own_seed == self.seed

    @property
    def lidar_model(self) -> LidarModel:
        """The lidar's specification."""
        return LIDAR_MODELS[self.lidar]

    def require_poses(self) -> Path:
        """Return the pose file.

        Raises:
            ConfigError: no pose file is set, or it does not exist.
        """
        if self.poses is None or not self.poses.is_file():
            raise ConfigError(f"simulation: no pose file at {self.poses}; give a KITTI or TUM pose file")
        return self.poses
