"""How far the IMU is believed: its noise as the innovations show it, and times in which its samples are left out.

An IMU is left out when the scans contradict it (:mod:`~hybridlio.sources.gate.innovation_gate`). It comes back when it
has agreed with the scans for a while. With each relapse that while doubles, so that a faulty IMU does harm a few times
only, however long the run; with time in agreement it shrinks again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S, Frame, ImuNoise, ImuSamples
from hybridlio.sources.gate.gate_result import GATE_NIS, GateResult

_FIRST_WAIT_NS, _LONGEST_WAIT_NS = NS_PER_S, 64 * NS_PER_S  # one second shows a bend or braking; a minute, a street
_FORGIVEN_AFTER = 10  # waits in agreement, after which the wait halves
_GAIN = 0.05  # of the noise per step: a memory of 20 steps, 2 s at 10 Hz
_LARGEST_SHARE = 9.0  # a step counts for no more: three standard deviations on each axis, beyond which it is an outlier
_LARGEST_LOG = np.log(1e4)  # variances 10,000 times those stated: an IMU 100 times worse says nothing any more


class ImuTrust:
    """Which samples are used, and with which noise.

    Args:
        noise: as stated, or assumed. Less noise than that is never believed.
    """

    def __init__(self, noise: ImuNoise) -> None:
        self._stated = noise
        self._log_scale = np.zeros(2)  # of the variances of gyroscope and accelerometer
        self._wait_ns = _FIRST_WAIT_NS
        self._since_ns = 0  # begin of the time in agreement
        self._left_out = False

    @property
    def left_out(self) -> bool:
        """Whether the IMU's samples are left out."""
        return self._left_out

    @property
    def noise(self) -> ImuNoise:
        """Noise densities that explain the innovations."""
        gyro, accel = self.noise_factors
        stated = self._stated
        return replace(
            stated,
            gyro_rad_s_sqrt_hz=gyro * stated.gyro_rad_s_sqrt_hz,
            accel_m_s2_sqrt_hz=accel * stated.accel_m_s2_sqrt_hz,
            gyro_walk_rad_s2_sqrt_hz=gyro * stated.gyro_walk_rad_s2_sqrt_hz,
            accel_walk_m_s3_sqrt_hz=accel * stated.accel_walk_m_s3_sqrt_hz,
        )

    @property
    def noise_factors(self) -> Array:
        """How many times the stated noise explains the innovations of gyroscope and accelerometer, ``(2,)``."""
        return np.asarray(np.exp(self._log_scale / 2))

    def learn(self, result: GateResult, stamp_ns: int) -> None:
        """Take the gate's result of the step to the scan at ``stamp_ns``."""
        if result.verdict == "IMU left out":
            self._watch(result.nis, stamp_ns)
        elif stamp_ns - self._since_ns > _FORGIVEN_AFTER * self._wait_ns:
            self._wait_ns, self._since_ns = max(self._wait_ns // 2, _FIRST_WAIT_NS), stamp_ns
        if result.parts is not None:
            change = _GAIN * (np.minimum(result.parts, _LARGEST_SHARE) - 1.0)
            self._log_scale = np.clip(self._log_scale + change, 0.0, _LARGEST_LOG)

    def _watch(self, nis: float | None, stamp_ns: int) -> None:
        """Begin to leave the samples out, or end it when they have agreed for long enough."""
        if not self._left_out:
            self._left_out, self._since_ns = True, stamp_ns
        elif nis is not None and nis > GATE_NIS:
            self._since_ns = stamp_ns
        elif stamp_ns - self._since_ns >= self._wait_ns:
            self._left_out, self._since_ns = False, stamp_ns
            self._wait_ns = min(2 * self._wait_ns, _LONGEST_WAIT_NS)  # should the scans contradict them again


def without_imu(frame: Frame) -> Frame:
    """Return the frame without its inertial samples."""
    return replace(frame, imu=ImuSamples.empty(), sweep_imu=ImuSamples.empty())
