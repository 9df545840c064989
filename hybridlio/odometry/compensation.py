"""Motion compensation of one frame: from a lidar motion near the sweep to the points as seen at the scan's stamp."""

from __future__ import annotations

from dataclasses import replace

from hybridlio.cloud.deskew import compensation_noise, constant_twist, deskew, sweep_motion
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Calibration, Frame, ImuNoise


class MotionCompensation:
    """Moves the points of a sweep to where the lidar would have seen them at the scan's stamp.

    The gyroscope gives the rotation during the sweep; the speed comes from a relative pose. Scans whose points carry
    no times need no compensation and pass unchanged.

    Args:
        calibration: the extrinsics.
        imu_noise: the gyroscope's noise, for :meth:`noise`.
    """

    def __init__(self, calibration: Calibration, imu_noise: ImuNoise) -> None:
        self._calibration, self._imu_noise = calibration, imu_noise

    @staticmethod
    def applies_to(frame: Frame) -> bool:
        """Return whether the points of the frame's scan carry times."""
        return frame.scan.time_offsets_ns is not None

    def compensate(self, frame: Frame, T_start_end: Array, start_ns: int, end_ns: int, gyro_bias_rad_s: Array) -> Frame:
        """Return the frame with a compensated scan.

        Args:
            frame: a frame, with the IMU samples of its sweep where there are any.
            T_start_end: ``(4, 4)`` lidar motion near the sweep, such as the initial pose of the step to this frame.
            start_ns, end_ns: stamps between which that motion takes place.
            gyro_bias_rad_s: ``(3,)`` the gyroscope's bias.
        """
        if not self.applies_to(frame):
            return frame
        step = constant_twist(T_start_end, start_ns, end_ns)
        motion = sweep_motion(frame, step, gyro_bias_rad_s, self._calibration)
        return replace(frame, scan=deskew(frame.scan, motion))

    def noise(self, frame: Frame) -> Array | None:
        """Return the covariance ``(6, 6)`` that compensation adds to the step to this frame; None without point times.

        See :func:`hybridlio.cloud.deskew.compensation_noise`.
        """
        return compensation_noise(frame, self._imu_noise) if self.applies_to(frame) else None
