"""The lidar's motion around a sweep by the IMU, sample by sample."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.core.sensors import LONGEST_INTERPOLATION_NS, NS_PER_S, Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory

_TURN_ROUNDS = 4  # of solving for a rate: each leaves the product of the turn and what was missing


def inertial_motion(
    imu: ImuSamples,
    state: State,
    T_start_end: Array,
    end_ns: int,
    calibration: Calibration,
    turns_by_gyroscope: bool = True,
) -> Trajectory | None:
    """Return lidar poses at the samples: rotation from the gyroscope, and the bend of the path from the accelerometer.

    A drone or a hand turns without its path turning with it, and a car does the opposite; the accelerometer tells them
    apart. The speed is such that the path leads through both ends of ``T_start_end``.

    Samples that start after the state's stamp, as those of an IMU that wakes up after the lidar, are continued back to
    it: the rate changes linearly to that of the first sample, from one by which the motion turns as ``T_start_end``.
    Within a period of the samples it stays as it is: a few milliseconds could take any turn.

    Args:
        imu: samples from the state's stamp, or before it, to beyond ``end_ns``; or starting shortly after the stamp.
        state: attitude, gravity and biases at the begin of the motion.
        T_start_end: ``(4, 4)`` lidar motion from the state's stamp to ``end_ns``.
        end_ns: a stamp.
        calibration: the extrinsics.
        turns_by_gyroscope: whether the rates hold; else they are changed to turn as ``T_start_end`` does.

    Returns:
        Poses ``T_world_lidar`` at the samples' stamps; None if there is no sample at both ends, or a gap.
    """
    begin_ns = int(imu.stamps_ns[0]) if len(imu) else 0
    is_late = begin_ns > state.stamp_ns and imu.starts_after(state.stamp_ns)
    if begin_ns > state.stamp_ns:
        imu = _with_sample_at(end_ns, imu.held_from(state.stamp_ns))
    stamps = imu.stamps_ns
    i, j = np.searchsorted(stamps, (state.stamp_ns, end_ns))
    if not (i < j < len(stamps) and stamps[i] == state.stamp_ns and stamps[j] == end_ns):
        return None
    if np.diff(stamps).max() > LONGEST_INTERPOLATION_NS:
        return None
    since_s = (stamps - state.stamp_ns) / NS_PER_S
    rates = imu.gyro_rad_s - state.gyro_bias_rad_s
    step, turned = _of_imu(T_start_end, calibration), slice(int(i), int(j) + 1)
    if is_late:
        before = np.maximum(1 - since_s * NS_PER_S / (begin_ns - state.stamp_ns), 0.0)
        for _ in range(_TURN_ROUNDS):
            rates = _turned_to(step[:3, :3], rates, before, since_s, turned)
    elif not turns_by_gyroscope:  # where they turn most: an error of scale grows with the rate
        rates = _turned_to(step[:3, :3], rates, np.linalg.norm(rates, axis=1), since_s, turned)
    R_world_imu = _rotations(rates, since_s)
    R_world_imu = state.T_world_imu[:3, :3] @ R_world_imu[i].T @ R_world_imu
    force = (imu.accel_m_s2 - state.accel_bias_m_s2)[..., None]
    bend = _bend((R_world_imu @ force)[..., 0] + state.gravity_m_s2, since_s, int(i))
    velocity = (state.T_world_imu[:3, :3] @ step[:3, 3] - bend[j]) / since_s[j]
    poses = se3.make(R_world_imu, bend + since_s[:, None] * velocity)
    return Trajectory(stamps, poses @ calibration.T_imu_lidar)


def lidar_turn(imu: ImuSamples, state: State, calibration: Calibration) -> Array:
    """Return the lidar's rotation ``(3, 3)`` from the first sample to the last by the gyroscope."""
    R = _rotations(imu.gyro_rad_s - state.gyro_bias_rad_s, (imu.stamps_ns - imu.stamps_ns[0]) / NS_PER_S)[-1]
    R_imu_lidar = calibration.T_imu_lidar[:3, :3]
    return np.asarray(R_imu_lidar.T @ R @ R_imu_lidar)


def _of_imu(T_start_end: Array, calibration: Calibration) -> Array:
    """Return the IMU's motion for the lidar's."""
    return np.asarray(calibration.T_imu_lidar @ T_start_end @ se3.inverse(calibration.T_imu_lidar))


def _turned_to(R_step: Array, rates: Array, weights: Array, times_s: Array, turned: slice) -> Array:
    """Return rates ``(S, 3)`` that turn nearly by ``R_step`` ``(3, 3)`` over a step, changed by weights ``(S,)``."""
    total = float(np.trapezoid(weights[turned], times_s[turned]))
    R = _rotations(rates[turned], times_s[turned])[-1]
    return np.asarray(rates + se3.so3_log(R.T @ R_step) * weights[:, None] / total) if total > 0 else rates


def _with_sample_at(stamp_ns: int, imu: ImuSamples) -> ImuSamples:
    """Return the samples with one at a stamp, interpolated where there is none."""
    at = int(np.searchsorted(imu.stamps_ns, stamp_ns))
    if not 0 < at < len(imu) or imu.stamps_ns[at] == stamp_ns:
        return imu
    return ImuSamples.concatenate([imu, imu.between(stamp_ns, stamp_ns)])


def _rotations(rates: Array, times_s: Array) -> Array:
    """Integrate angular rates ``(S, 3)`` to rotations ``(S, 3, 3)`` relative to the first."""
    return se3.so3_chain(se3.so3_exp(se3.turns_by_rates(rates, np.diff(times_s))))


def _bend(acceleration: Array, times_s: Array, at: int) -> Array:
    """Integrate accelerations ``(S, 3)`` twice, to zero displacement and velocity at sample ``at``."""
    steps = np.diff(times_s)[:, None]
    before, after = acceleration[:-1], acceleration[1:]
    zero = np.zeros((1, 3))
    velocity = np.concatenate([zero, np.cumsum((before + after) / 2 * steps, axis=0)])
    # linear between two samples
    moved = np.concatenate([zero, np.cumsum(velocity[:-1] * steps + (2 * before + after) / 6 * steps**2, axis=0)])
    return np.asarray(moved - moved[at] - velocity[at] * (times_s - times_s[at])[:, None])
