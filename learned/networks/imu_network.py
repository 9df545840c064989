"""The initial pose from inertial data: a pair of LSTMs, acceleration to translation, angular velocity to orientation.

Source: UnDeepLIO, "Estimating initial relative pose from IMU". Rows are those of
:func:`hybridlio.learned.data.imu_rows.imu_rows`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.layers import rotation_matrix
from hybridlio.learned.settings import NetworkSettings

_RATE_RAD_S = 0.5  # input scale: about 29°/s, a road vehicle in a sharp turn; part of the trained weights


class ImuNetwork(nn.Module):
    """Two LSTMs of the same structure over ``S`` rows; with ``siamese="shared"`` they share their weights.

    Rows are divided by 9.81 m/s² and 0.5 rad/s, so that inputs are of order 1. With ``velocity`` the translation LSTM
    also takes the last velocity (in units of 10 m/s) in every row, and its output is added to that velocity times the
    time between the scans: acceleration alone does not determine a constant speed. A shared LSTM takes the velocity for
    both inputs. With ``mean_rate`` the orientation LSTM's output is added to the rotation at the mean angular velocity.
    The last layers start small and without bias, so that training starts near the identity or near that first guess.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.accel_lstm = _lstm(settings, 6 if settings.velocity else 3)
        self.shared = settings.siamese == "shared"
        self.gyro_lstm = self.accel_lstm if self.shared else _lstm(settings, 3)
        if settings.imu != "feature":
            self.translation = nn.Linear(settings.imu_hidden, 3)
            self.rotation = nn.Linear(settings.imu_hidden, 3)
            with torch.no_grad():
                for layer in (self.translation, self.rotation):
                    layer.weight *= settings.residual_scale
                    layer.bias.zero_()

    def features(self, imu: Tensor, velocity_m_s: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the LSTMs' last outputs ``(B, hidden)``, for accelerations and for angular velocities.

        Args:
            imu: ``(B, S, 6)``, angular velocity (rad/s) and specific force (m/s²).
            velocity_m_s: ``(B, 3)`` at the last scan, in its axes; ignored unless ``settings.velocity``.
        """
        accel, gyro = imu[..., 3:] / GRAVITY_M_S2, imu[..., :3] / _RATE_RAD_S
        if self.settings.velocity and velocity_m_s is not None:
            velocity = (velocity_m_s / 10.0)[:, None].expand_as(accel)
            accel = torch.cat([accel, velocity], dim=-1)
            if self.shared:  # a shared LSTM needs the same number of columns for both inputs
                gyro = torch.cat([gyro, velocity], dim=-1)
        return self.accel_lstm(accel)[0][:, -1], self.gyro_lstm(gyro)[0][:, -1]

    def forward(self, imu: Tensor, velocity_m_s: Tensor | None = None, dt_s: Tensor | None = None) -> Tensor:
        """Return initial poses ``T_k_k1`` ``(B, 4, 4)``; arguments as :meth:`features`, and ``dt_s`` ``(B,)``."""
        of_accel, of_gyro = self.features(imu, velocity_m_s)
        scale = self.settings.output_scale
        t = scale * self.translation(of_accel)
        if self.settings.velocity and velocity_m_s is not None and dt_s is not None:
            t = t + velocity_m_s * dt_s[:, None]
        turned = scale * self.rotation(of_gyro)
        if self.settings.mean_rate and dt_s is not None:
            gyro = imu[..., :3]
            mean = ((gyro[:, 1:] + gyro[:, :-1]) / 2).mean(dim=1)
            turned = turned + mean * dt_s[:, None]
        return se3.make(rotation_matrix(turned, self.settings), t)


def _lstm(settings: NetworkSettings, inputs: int) -> nn.LSTM:
    return nn.LSTM(inputs, settings.imu_hidden, settings.imu_layers, batch_first=True)
