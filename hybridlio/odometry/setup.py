"""Arguments of the implementations of the seams: the configuration, and the sensors as the first frame states them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from hybridlio.core.sensors import NOISE_DENSITIES, Calibration, Frame, ImuNoise
from hybridlio.core.setting_checks import check_positive

if TYPE_CHECKING:  # the command line imports this module and must start quickly
    from hybridlio.core.estimates import RelativePose, State
    from hybridlio.graph.run.inertial_steps import InertialSteps
    from hybridlio.odometry.config import Config


@dataclass(frozen=True, eq=False)
class Setup:
    """Arguments for the functions in :mod:`hybridlio.odometry.registry`.

    Attributes:
        config: all settings.
        calibration: the extrinsics.
        imu_noise: the IMU's noise densities.
    """

    config: Config
    calibration: Calibration
    imu_noise: ImuNoise

    @classmethod
    def from_frame(cls, config: Config, frame: Frame) -> Setup:
        """Return the setup for a run that starts at ``frame``.

        The IMU's noise is the configuration's if it gives one, else the recording's, else that of a MEMS unit.

        Raises:
            SettingError: a noise density is 0. A simulator may have such an IMU, but the graph cannot weigh it. Only
                an error of scale may be missing.
        """
        noise = config.imu_noise or frame.imu_noise or ImuNoise()
        check_positive(noise, *NOISE_DENSITIES)
        return cls(config, frame.calibration or Calibration(), noise)

    @cached_property
    def inertial_steps(self) -> InertialSteps:
        """Preintegration that the initial pose, the gate and the backend share, so that each step is done once."""
        from hybridlio.graph.run.inertial_steps import InertialSteps

        return InertialSteps(self.calibration, self.imu_noise)

    def use_noise(self, noise: ImuNoise) -> None:
        """Preintegrate with this noise from now on. Without inertial data so far, nothing is loaded for it."""
        if "inertial_steps" in vars(self):
            self.inertial_steps.noise = noise

    def predict_from_imu(self, frame: Frame, state: State) -> RelativePose | None:
        """Return the step from ``state`` to ``frame`` by the IMU; None if its samples do not cover it."""
        return self.inertial_steps.predicted(frame, state)
