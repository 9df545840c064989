"""Use your own source of initial poses: wheel speed and a gyroscope.

A source is any object with a name, `predict` and `correct`; it is neither registered nor inherited. Here, the wheel
speed is the forward speed of the recording's navigation system.

    python examples/own_initial_pose_source.py [FOLDER] [SECONDS]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import hybridlio as hl
from hybridlio.core import se3


class WheelsAndGyroscope:
    """Takes the distance from the wheels and the rotation from the gyroscope."""

    name = "wheels-and-gyroscope"

    def __init__(self, sequence: hl.Sequence) -> None:
        self._speed_m_s = sequence.forward_speed_m_s
        self._R_lidar_imu = sequence.calibration.T_imu_lidar[:3, :3].T

    def predict(self, frame: hl.Frame, state: hl.State) -> hl.RelativePose:
        """Return the relative pose ``T_k_k1`` to ``frame``, with the covariance of wheels and gyroscope."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / 1e9
        rotation = self._R_lidar_imu @ frame.imu.gyro_rad_s.mean(axis=0) * dt_s
        translation = np.array([self._speed_m_s[frame.index] * dt_s, 0.0, 0.0])
        sigmas = np.array([2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05])  # rad, m
        pose = se3.exp(np.concatenate([rotation, translation]))
        return hl.RelativePose(pose, np.diag(sigmas**2), source=self.name, from_imu=True)

    def correct(self, frame: hl.Frame, estimate: hl.RelativePose) -> None:
        """Do nothing; a filter would use the final estimate of the step here."""


def main(folder: str | None = None, seconds: str = "5") -> None:
    root = Path(folder or tempfile.mkdtemp(prefix="hybridlio-"))
    drive = hl.simulate(root, hl.SimulationConfig(seconds=float(seconds), seed=7, lidar="16-beam"))
    sequence = hl.open_sequence(drive)
    for source in (WheelsAndGyroscope(sequence), "constant-velocity"):
        odometry = hl.Odometry(initial_pose=source)
        estimates = [odometry.step(frame) for frame in sequence]
        steps = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
        initial = np.array([estimate.initial.pose for estimate in estimates[1:]])
        error = se3.log(se3.between(steps, initial))
        name = source if isinstance(source, str) else source.name
        print(f"{name}: mean error of the initial poses {np.linalg.norm(error[:, 3:], axis=1).mean():.3f} m per step")


if __name__ == "__main__":
    main(*sys.argv[1:])
