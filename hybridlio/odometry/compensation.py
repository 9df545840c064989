"""Motion compensation of one frame: from a lidar motion near the sweep to the points as seen at the scan's stamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.cloud.deskew import compensation_noise, constant_twist, deskew, sweep_motion
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.odometry.inertial_motion import inertial_motion


class MotionCompensation:
    """Moves the points of a sweep to where the lidar would have seen them at the scan's stamp.

    The IMU gives rotation and bend of the path during the sweep, the speed comes from a relative pose. Scans whose
    points carry no times need no compensation and pass unchanged.

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

    def compensate(
        self,
        frame: Frame,
        T_start_end: Array,
        start_ns: int,
        end_ns: int,
        state: State | None,
        imu: ImuSamples,
        *,
        turns_by_gyroscope: bool = True,
    ) -> Frame:
        """Return the frame with a compensated scan.

        Args:
            frame: a frame, with the IMU samples of its sweep where there are any.
            T_start_end: ``(4, 4)`` lidar motion near the sweep, such as the initial pose of the step to this frame.
            start_ns, end_ns: stamps between which that motion takes place.
            state: at ``start_ns``; None if it is not known yet.
            imu: samples between both stamps.
            turns_by_gyroscope: whether the gyroscope's rates hold, see :func:`inertial_motion`.
        """
        if not self.applies_to(frame):
            return frame
        motion = None
        if state is not None and len(imu):
            samples = ImuSamples.concatenate([imu, frame.sweep_imu])
            motion = inertial_motion(samples, state, T_start_end, end_ns, self._calibration, turns_by_gyroscope)
        if motion is None:
            step = constant_twist(T_start_end, start_ns, end_ns)
            bias = np.zeros(3) if state is None else state.gyro_bias_rad_s
            motion = sweep_motion(frame, step, bias, self._calibration)
        return replace(frame, scan=deskew(frame.scan, motion))

    def noise(self, frame: Frame) -> Array | None:
        """Return the covariance ``(6, 6)`` that compensation adds to the step to this frame; None without point times.

        See :func:`hybridlio.cloud.deskew.compensation_noise`.
        """
        return compensation_noise(frame, self._imu_noise) if self.applies_to(frame) else None
