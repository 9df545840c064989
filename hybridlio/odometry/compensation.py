"""Motion compensation of one frame: from a lidar motion near the sweep to the points as seen at the scan's stamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.cloud.deskew import compensation_noise, constant_twist, deskew, sweep_duration_s, sweep_motion
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.odometry.inertial_motion import inertial_motion
from hybridlio.sources.gate.motion_change import UsualChange


class MotionCompensation:
    """Moves the points of a sweep to where the lidar would have seen them at the scan's stamp.

    The IMU gives rotation and bend of the path during the sweep, the speed comes from a relative pose. Scans whose
    points carry no times need no compensation and pass unchanged.

    Args:
        calibration: the extrinsics.
        imu_noise: the gyroscope's noise, for :meth:`noise`.
        first_ns: stamp of the first scan.
    """

    def __init__(self, calibration: Calibration, imu_noise: ImuNoise, first_ns: int = 0) -> None:
        self._calibration, self._imu_noise = calibration, imu_noise
        self._change, self._stamp_ns = UsualChange(), first_ns

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
        samples = ImuSamples.concatenate([imu, frame.sweep_imu])
        if state is not None and state.has_imu and len(samples):
            motion = inertial_motion(samples, state, T_start_end, end_ns, self._calibration, turns_by_gyroscope)
        if motion is None:
            step = constant_twist(T_start_end, start_ns, end_ns)
            bias = np.zeros(3) if state is None else state.gyro_bias_rad_s
            motion = sweep_motion(frame, step, bias, self._calibration)
        return replace(frame, scan=deskew(frame.scan, motion))

    def learn(self, step: RelativePose | None, stamp_ns: int) -> None:
        """Take the step to a scan, by which sweeps are compensated without an IMU; None if it was not found."""
        step_s = (stamp_ns - self._stamp_ns) / NS_PER_S
        self._change.learn(None if step is None else se3.log(step.pose) / step_s)
        self._stamp_ns = stamp_ns

    def noise(self, frame: Frame, before_ns: int) -> Array | None:
        """Return the covariance ``(6, 6)`` that compensation adds to the step to this frame; None without point times.

        Without an IMU sweeps are compensated with the mean motion of the step. While sweeps follow each other at once,
        scan matching has seen it; between sweeps nothing has.

        Args:
            frame: the frame.
            before_ns: stamp of the scan before.

        See :func:`hybridlio.cloud.deskew.compensation_noise`.
        """
        if not self.applies_to(frame):
            return None
        step_s = (frame.scan.stamp_ns - before_ns) / NS_PER_S
        unseen = max(1.0 - sweep_duration_s(frame) / step_s, 0.0)
        return compensation_noise(frame, self._imu_noise, unseen * self._change.sigmas(step_s))
