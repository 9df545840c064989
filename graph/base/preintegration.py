"""IMU preintegration by GTSAM.

Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", TRO 2017.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import (
    ANGULAR_ACCELERATION_SIGMA_RAD_S2,
    BRIDGED_ACCELERATION_SIGMA_M_S2,
    JERK_SIGMA_M_S3,
    LARGEST_ACCELERATION_M_S2,
    LARGEST_RATE_RAD_S,
)
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples

_INTEGRATION_VARIANCE = 1e-8  # m²/s: GTSAM needs it positive; 0.1 mm per √s is far below what the accelerometer adds
MOST_TURN_RAD = np.pi  # of samples that make one factor, see makes_one_factor
_PART_TURN_RAD = np.pi / 2  # of a part of a longer turn
_COVER_SLACK_NS = NS_PER_S // 1000  # stamps are often rounded to milliseconds
# Random walk of the biases over a gap in the samples, m/s³ and rad/s² per √Hz: 30 and 50 times the defaults of
# ImuNoise, because nothing is known about the sensor during a gap.
_GAP_ACCEL_WALK, _GAP_GYRO_WALK = 1e-2, 1e-3


def sampling_noise(noise: ImuNoise, gap_s: float) -> tuple[float, float]:
    """Return white-noise densities ``(accel, gyro)`` of an IMU whose longest time between two samples is ``gap_s``.

    To the sensor's own noise it adds the motion that samples so far apart cannot show. An acceleration that leaves the
    line between two samples at the vehicle's typical jerk J, and returns half-way, differs from it by J·gap/4 on
    average; it never differs by more than a vehicle can accelerate. The same holds for rates. A deviation that is
    constant over the gap changes the speed by deviation·gap, as white noise of density deviation·√gap does.
    """
    accel = min(JERK_SIGMA_M_S3 * gap_s / 4, LARGEST_ACCELERATION_M_S2) * np.sqrt(gap_s)
    gyro = min(ANGULAR_ACCELERATION_SIGMA_RAD_S2 * gap_s / 4, LARGEST_RATE_RAD_S) * np.sqrt(gap_s)
    return float(np.hypot(noise.accel_m_s2_sqrt_hz, accel)), float(np.hypot(noise.gyro_rad_s_sqrt_hz, gyro))


def with_scale_error(noise: ImuNoise, imu: ImuSamples, state: State) -> ImuNoise:
    """Return the noise of the samples with that of the gyroscope's unknown scale in it.

    After a turn θ a scale and misalignment of relative standard deviation s leave each axis s·θ off, as white noise of
    density s·θ/√t does after the time t. The turn that counts is the largest on the way: a motion to and fro takes the
    error back.
    """
    duration_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S
    by_scale = noise.gyro_scale_sigma * imu.largest_turn_rad(state.gyro_bias_rad_s) / np.sqrt(duration_s)
    return replace(noise, gyro_rad_s_sqrt_hz=float(np.hypot(noise.gyro_rad_s_sqrt_hz, by_scale)))


def preintegration_params(noise: ImuNoise, gap_s: float, gravity: Array) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for samples at most ``gap_s`` seconds apart, with gravity ``(3,)`` in world."""
    accel, gyro = sampling_noise(noise, gap_s)
    params = gtsam.PreintegrationCombinedParams(gravity)
    params.setAccelerometerCovariance(np.eye(3) * accel**2)
    params.setGyroscopeCovariance(np.eye(3) * gyro**2)
    params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_VARIANCE)
    params.setBiasAccCovariance(np.eye(3) * noise.accel_walk_m_s3_sqrt_hz**2)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyro_walk_rad_s2_sqrt_hz**2)
    return params


def gtsam_bias(state: State) -> gtsam.imuBias.ConstantBias:
    """Return the state's biases as GTSAM's type."""
    return gtsam.imuBias.ConstantBias(state.accel_bias_m_s2, state.gyro_bias_rad_s)


def preintegrate(imu: ImuSamples, state: State, noise: ImuNoise) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate the samples from the state's stamp to the last one, with the state's biases and gravity.

    The trapezoidal rule: each step between two samples takes their mean. The noise grows with the longest step
    (:func:`sampling_noise`) and with the turn (:func:`with_scale_error`).

    Raises:
        DataError: there are fewer than two samples.
    """
    _check_count(imu, state)
    return _preintegrated(imu, state, with_scale_error(noise, imu, state))


def _preintegrated(imu: ImuSamples, state: State, noise: ImuNoise) -> gtsam.PreintegratedCombinedMeasurements:
    pim = gtsam.PreintegratedCombinedMeasurements(_params_for(imu, state, noise), gtsam_bias(state))
    _integrate(pim, imu, state)
    return pim


def preintegrate_constant_biases(
    imu: ImuSamples, state: State, noise: ImuNoise
) -> gtsam.PreintegratedImuMeasurements:  # fmt: skip
    """Preintegrate as :func:`preintegrate`, for biases that do not walk."""
    _check_count(imu, state)
    params = _params_for(imu, state, with_scale_error(noise, imu, state))
    pim = gtsam.PreintegratedImuMeasurements(params, gtsam_bias(state))
    _integrate(pim, imu, state)
    return pim


def _check_count(imu: ImuSamples, state: State) -> None:
    if len(imu) < 2:
        raise DataError(f"preintegration: {len(imu)} IMU samples after {state.stamp_ns} ns, at least 2 are needed")


def _params_for(imu: ImuSamples, state: State, noise: ImuNoise) -> gtsam.PreintegrationCombinedParams:
    longest_s = float(np.diff(imu.stamps_ns).max()) / NS_PER_S
    return preintegration_params(noise, longest_s, state.gravity_m_s2)


def _integrate(pim: Any, imu: ImuSamples, state: State) -> None:
    steps_s = np.diff(imu.stamps_ns) / NS_PER_S
    gyro = (imu.gyro_rad_s[1:] + imu.gyro_rad_s[:-1]) / 2
    # GTSAM takes the specific force in the sensor's frame at the start of the step (Euler integration); the second
    # sample is measured at its end, so it is rotated back by the turn in between before the mean is taken
    turned = se3.so3_exp(imu.turns(state.gyro_bias_rad_s))
    accel = (imu.accel_m_s2[:-1] + (turned @ imu.accel_m_s2[1:, :, None])[..., 0]) / 2
    for step_s, a, w in zip(steps_s, accel, gyro, strict=True):
        pim.integrateMeasurement(a, w, step_s)


def preintegrate_unknown(state: State, dt_s: float) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate a step of ``dt_s`` seconds without samples: at constant velocity, changed as a vehicle may.

    The same factor as for samples then ties the velocity to both poses. Rotation and acceleration are zero, with the
    largest rate and the usual acceleration as their uncertainty; the biases walk freely.
    """
    params = gtsam.PreintegrationCombinedParams(state.gravity_m_s2)
    params.setAccelerometerCovariance(np.eye(3) * BRIDGED_ACCELERATION_SIGMA_M_S2**2 * dt_s)
    params.setGyroscopeCovariance(np.eye(3) * LARGEST_RATE_RAD_S**2 * dt_s)
    params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_VARIANCE)
    params.setBiasAccCovariance(np.eye(3) * _GAP_ACCEL_WALK**2)
    params.setBiasOmegaCovariance(np.eye(3) * _GAP_GYRO_WALK**2)
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam_bias(state))
    at_rest = -state.T_world_imu[:3, :3].T @ state.gravity_m_s2
    pim.integrateMeasurement(state.accel_bias_m_s2 + at_rest, state.gyro_bias_rad_s, dt_s)
    return pim


def makes_one_factor(imu: ImuSamples, state: State) -> bool:
    """Whether the samples turn by half a turn or less, so that one factor describes them.

    GTSAM's factors preintegrate rotations in the tangent space at the start, which is singular at a whole turn: at 5°
    per sample, half a turn is 0.03° off, 0.8 turns 0.15°, a whole one 2.4°, and two are 11° and 4 m off in 4 s, with a
    covariance that claims far less.
    """
    return imu.largest_turn_rad(state.gyro_bias_rad_s) <= MOST_TURN_RAD


def covers(imu: ImuSamples, start_ns: int, end_ns: int) -> bool:
    """Whether the samples reach from ``start_ns`` to ``end_ns``, within a millisecond."""
    if len(imu) < 2:
        return False
    return bool(imu.stamps_ns[0] <= start_ns + _COVER_SLACK_NS and imu.stamps_ns[-1] >= end_ns - _COVER_SLACK_NS)


def predict_step(pim: gtsam.PreintegratedCombinedMeasurements, state: State) -> tuple[Array, Array]:
    """Return the IMU's pose ``(4, 4)`` after the samples in its pose before them, with covariance ``(6, 6)``.

    The covariance propagates the state's (velocity, tilt, biases, gravity) and the noise of the samples.
    """
    then, J = navigation_after(pim, navigation_of(state), gtsam_bias(state))
    return _step(state, then, J, pim.preintMeasCov(), pim.deltaTij())


def predict_in_parts(imu: ImuSamples, state: State, noise: ImuNoise) -> tuple[Array, Array]:
    """Return what :func:`predict_step` does for samples of any turn: parts of a quarter turn, one after the other."""
    then, J, added = navigation_of(state), np.eye(15), np.zeros((15, 15))
    noise = with_scale_error(noise, imu, state)  # of the whole turn: parts have the same error of scale
    for part in _parts(imu, state):
        pim = _preintegrated(part, state, noise)
        then, by_part = navigation_after(pim, then, gtsam_bias(state))
        J, added = by_part @ J, by_part @ added @ by_part.T + pim.preintMeasCov()
    return _step(state, then, J, added, float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S)


def navigation_of(state: State) -> gtsam.NavState:
    """Return pose and velocity as GTSAM's type."""
    return gtsam.NavState(gtsam.Pose3(state.T_world_imu), state.velocity_m_s)


def navigation_after(
    pim: gtsam.PreintegratedCombinedMeasurements, before: gtsam.NavState, bias: gtsam.imuBias.ConstantBias
) -> tuple[gtsam.NavState, Array]:
    """Return the navigation state after samples, and its derivatives ``(15, 15)`` by that before and by the biases."""
    by_state, by_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
    then = pim.predict(before, bias, by_state, by_bias)
    J = np.eye(15)
    J[:9, :9], J[:9, 9:] = by_state, by_bias
    return then, J


def _step(state: State, then: gtsam.NavState, J: Array, noise: Array, duration_s: float) -> tuple[Array, Array]:
    """Return the step from a state to the navigation state after it, from its derivatives and the samples' noise."""
    step = se3.between(state.T_world_imu, then.pose().matrix())
    R_world_imu, R_step = state.T_world_imu[:3, :3], step[:3, :3]
    by_state = J[:9, :9].copy()
    # GTSAM perturbs a NavState's velocity in the body frame; the state's covariance is of the velocity in world
    by_state[:, 6:] = by_state[:, 6:] @ R_world_imu.T
    # step = now⁻¹·then: its perturbation is that of the pose after, less Ad(step⁻¹) times that of the pose before
    by_pose = by_state[:6, :6] - se3.adjoint(se3.inverse(step))
    J = np.hstack([by_pose, by_state[:6, 6:], J[:6, 9:]])
    # gravity g moves the end by g·dt²/2 in world; a right perturbation's translation is in the frame of the end
    half_dt2 = duration_s**2 / 2
    by_gravity = np.vstack([np.zeros((3, 3)), half_dt2 * (R_world_imu @ R_step).T])
    covariance = J @ state.covariance @ J.T + by_gravity @ state.gravity_covariance @ by_gravity.T + noise[:6, :6]
    return step, (covariance + covariance.T) / 2


def _parts(imu: ImuSamples, state: State) -> list[ImuSamples]:
    """Return the samples in parts that turn by a quarter turn or less, each from the last sample of the one before."""
    angles = np.linalg.norm(imu.turns(state.gyro_bias_rad_s), axis=1)
    part_of_step = (np.cumsum(angles) / _PART_TURN_RAD).astype(int)
    cuts = [0, *(np.flatnonzero(np.diff(part_of_step)) + 1).tolist(), len(angles)]
    return [
        ImuSamples(imu.stamps_ns[a : b + 1], imu.gyro_rad_s[a : b + 1], imu.accel_m_s2[a : b + 1])
        for a, b in pairwise(cuts)
    ]
