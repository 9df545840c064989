"""Settings of a simulated recording of a platform."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from hybridlio.simulation.platforms.bodies import BODIES
from hybridlio.simulation.platforms.imu_grades import IMU_GRADES
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.scenes.table import SCENES

DEFAULT_SECONDS = 60.0


class PlatformConfig(BaseModel):
    """Settings of a recording of a platform; the same settings give the same bytes.

    Attributes:
        scene: a name of :data:`hybridlio.simulation.platforms.scenes.table.SCENES`.
        platform: a name of :data:`hybridlio.simulation.platforms.bodies.BODIES`; None for the scene's usual one.
        lidar: a name of :data:`hybridlio.simulation.platforms.lidars.SCANNERS`.
        imu: a name of :data:`hybridlio.simulation.platforms.imu_grades.IMU_GRADES`.
        seconds: duration.
        seed: of scene, motion, mounts and noise.
        people: number of people who walk around the sensor.
        drive_seed: of motion, mounts and noise, by default ``seed``. Another one is another walk or ride
            through the same scene.
        start_moving: start in motion instead of standing for the first second.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: str = "office"
    platform: str = ""
    lidar: str = "os0"
    imu: str = "consumer-mems"
    seconds: float = Field(default=DEFAULT_SECONDS, ge=0.5, le=3600.0, allow_inf_nan=False)
    seed: int = Field(default=1, ge=0)
    people: int = Field(default=0, ge=0, le=1000)
    drive_seed: int | None = Field(default=None, ge=0)
    start_moving: bool = True

    @model_validator(mode="before")
    @classmethod
    def _usual_platform(cls, values: Any) -> Any:
        if isinstance(values, dict) and not values.get("platform"):
            scene = SCENES.get(str(values.get("scene", "office")))
            values = {**values, "platform": scene.platform if scene else "handheld"}
        return values

    @field_validator("scene", "platform", "lidar", "imu")
    @classmethod
    def _known(cls, name: str, info: Any) -> str:
        tables: dict[str, dict[str, Any]] = {"scene": SCENES, "platform": BODIES, "lidar": SCANNERS, "imu": IMU_GRADES}
        known = tables[info.field_name]
        if name not in known:
            raise ValueError(f"unknown {info.field_name} {name!r}; choose one of {', '.join(known)}")
        return name

    @property
    def name(self) -> str:
        """The name of the recording's folder."""
        again = "" if self.drive_seed is None else f"-{self.drive_seed}"
        return f"{self.scene}-{self.platform}-{self.lidar}-{self.seed}{again}"

    @property
    def own_seed(self) -> int:
        """Seed of what differs between two rides through one scene."""
        return self.seed if self.drive_seed is None else self.drive_seed
