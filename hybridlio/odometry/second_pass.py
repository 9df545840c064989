"""A second registration of a scan whose sweep is compensated otherwise by its own motion than by the predicted one.

A sweep that is compensated with a speed that is wrong by ``δ`` displaces the points on average by ``δ·τ``, where ``τ``
is their mean time after the scan's stamp, and registration moves the scan by as much the other way. While the run
knows its speed by few steps alone, this error of a step goes into the next speed with the opposite sign: positions
swing by centimetres around the path from scan to scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RefinesAgain, RelativePose, State, TakesBack
from hybridlio.core.motion_limits import LEVEL_SINE, POINT_LEVER_M, UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.odometry.inertial_motion import lidar_turn

# Displacement of the sweep's last points, over the spread of the residuals, from which a scan is registered again. The
# mean displacement, which moves the scan, is half of it.
_LEAST_RATIO = 1.0
_SIGMAS = 3.0  # of the gyroscope's scale
# Of a platform at rest: standard deviations of its samples within a step, over those of consumer IMUs (0.003 rad/s and
# 0.03 m/s² at 200 Hz) and a standing person's tremor, and below those of a walk (from 0.3 m/s²) or of motors.
_QUIET_RAD_S, _QUIET_M_S2, _FEWEST_QUIET, _BIAS_SIGMAS = 0.02, 0.15, 5, 3.0
_REST_M_S = 0.1  # 1 cm at 10 Hz, the error of a step; a standing person sways by less
_ANY_TURN_RAD = 10.0


@dataclass(frozen=True, eq=False)
class SecondCompensation:
    """How to compensate a scan once more.

    Attributes:
        T_start_end: ``(4, 4)`` lidar motion of the step to the scan.
        turns_by_gyroscope: whether the gyroscope's rates hold; else they are changed so that they turn as the motion.
    """

    T_start_end: Array
    turns_by_gyroscope: bool


def second_compensation(
    frame: Frame,
    initial: RelativePose,
    found: RelativePose,
    before: State,
    calibration: Calibration,
    imu_noise: ImuNoise,
    weighs: bool,
) -> SecondCompensation | None:
    """Return how to compensate a scan once more; None if its points would move by less than their noise.

    Registration found the step ``f`` with points compensated for the step ``p``. With the step's duration ``T``, ``f``
    errs by ``−τ/T`` of the error ``δ`` of ``p`` and by its own scatter, so that ``p − f = s·δ`` plus scatter, with
    ``s = (T + τ)/T``. A ``p`` whose speed is that of the last steps errs as these do, with the opposite sign, and ``f``
    is right.

    While the run finds its speed, ``δ`` is taken to be the difference over ``s``. But the difference has the error of
    where the scan before was placed, too. A sweep stamped at its end has ``s = ½``: twice that error went into the
    second pass, and where only rows at the sweep's begin see the ground, scans swung ever farther until the IMU was
    left out (a street, a wood and a mine with a lidar of 120° × 25°: 4 to 600 m off, and now 1 to 3 cm). So ``s``
    counts as 1 at least.

    Where ``p`` knows its speed, its error in translation is the likeliest one by the covariances ``P`` of ``p`` and
    ``R`` of ``f``: ``s·P·(s²·P + R)⁻¹·(p − f)``. A match may know less: along a stairwell, matches of 16 beams at 20 Hz
    err by 1 to 3 cm, and predictions by 1 mm. Compensated by the whole difference, scans swung ever farther, by 5 cm
    from one to the next, until the IMU was left out and the path 1.1 m off, not 2 cm. The gyroscope is right within
    hundredths of a degree, unless its scale is wrong and the step turns by tens of degrees. A turn that no error of
    scale explains is a wrong match rather.

    Args:
        frame: as recorded.
        initial: initial relative pose of the step, by whose translation the scan was compensated.
        found: the step of the first pass, with the spread of its residuals in ``details``.
        before: the state at the scan before.
        calibration: the extrinsics.
        imu_noise: with the standard deviation of the gyroscope's scale.
        weighs: whether the initial pose knows its speed.
    """
    offsets_ns, noise_m = frame.scan.time_offsets_ns, found.details.get("sigma_m", np.inf)
    if not found.ok or offsets_ns is None or not len(offsets_ns):
        return None
    step_s = (frame.scan.stamp_ns - before.stamp_ns) / NS_PER_S
    mean_s, sweep_s = offsets_ns.mean() / NS_PER_S, np.abs(offsets_ns).max() / NS_PER_S
    by_imu = len(frame.imu) > 0
    turn = lidar_turn(frame.imu, before, calibration) if by_imu else initial.pose[:3, :3]
    compensated_by = se3.make(turn, initial.pose[:3, 3])
    share = (step_s + mean_s) / step_s
    apart = se3.log(se3.between(compensated_by, found.pose))
    error = apart / max(share, 1.0)
    if weighs:
        gain = share * initial.covariance @ np.linalg.inv(share**2 * initial.covariance + found.covariance)
        error[3:] = (gain @ apart)[3:]
    moved_m = np.linalg.norm(error.reshape(2, 3), axis=1) * (POINT_LEVER_M, 1.0) * sweep_s / step_s
    by_scale_rad = _SIGMAS * imu_noise.gyro_scale_sigma * float(np.linalg.norm(se3.so3_log(turn)))
    holds = by_imu and bool(moved_m[0] <= _LEAST_RATIO * noise_m or np.linalg.norm(error[:3]) > by_scale_rad)
    if holds:
        error[:3], moved_m[0] = 0.0, 0.0
    if moved_m.sum() <= _LEAST_RATIO * noise_m:
        return None
    return SecondCompensation(compensated_by @ se3.exp(error), holds)


def without_misfit(
    residual: RefinesAgain, initial: RelativePose, found: RelativePose, lost_cost: float
) -> RelativePose:
    """Return the initial pose as a failed step, if it was so vague that a scan which fits nowhere was put anywhere."""
    is_vague = initial.translation_sigma_m > UNKNOWN_TRANSLATION_SIGMA_M
    if is_vague and found.ok and found.details.get("cost", 0.0) > lost_cost and isinstance(residual, TakesBack):
        residual.take_back(initial)
        return replace(initial, ok=False, drift=found.drift, details=found.details)
    return found


def held_at_rest(calibration: Calibration, frame: Frame, step: RelativePose, before: State) -> RelativePose:
    """Return the step with no motion along directions that the scan leaves open, if the platform is at rest.

    A lidar that sees neither floor nor ceiling does not observe its height, and the speed upwards at the start is not
    known otherwise. At rest the IMU is quiet and the scans show no motion on the level. A body that moves so does not
    rise or sink steadily. Along the level it may: a car in a smooth tunnel looks the same.

    Args:
        calibration: the extrinsics.
        frame: with the samples of the step.
        step: as the scans give it.
        before: the state at the scan before.
    """
    if not (step.ok and len(step.degenerate) and _is_quiet(frame.imu, before)):
        return step
    up = before.up_in_lidar(calibration)
    level = np.eye(3) - np.outer(up, up)
    rest_m = _REST_M_S * (frame.scan.stamp_ns - before.stamp_ns) / NS_PER_S
    if (
        np.linalg.norm(level @ step.pose[:3, 3]) > rest_m
        or np.linalg.norm(step.degenerate[:, 3:] @ level, axis=1).max() > LEVEL_SINE
    ):
        return step
    moved, rest = se3.log(step.pose), np.diag(np.r_[np.full(3, _ANY_TURN_RAD), np.full(3, rest_m)] ** 2)
    kept = rest @ np.linalg.inv(step.covariance + rest)  # the rest has no motion
    covariance = kept @ step.covariance
    drift = None if step.drift is None else kept @ step.drift @ kept.T
    return replace(step, pose=se3.exp(kept @ moved), covariance=(covariance + covariance.T) / 2, drift=drift)


def _is_quiet(imu: ImuSamples, state: State) -> bool:
    """Return whether samples show neither a turn nor anything that shakes the platform."""
    if len(imu) < _FEWEST_QUIET:
        return False
    bias_sigma = float(np.sqrt(np.diag(state.covariance)[12:15].max()))
    turns = np.abs(imu.gyro_rad_s.mean(axis=0) - state.gyro_bias_rad_s).max()
    shaken = imu.gyro_rad_s.std(axis=0).max() > _QUIET_RAD_S or imu.accel_m_s2.std(axis=0).max() > _QUIET_M_S2
    return bool(not shaken and turns < _QUIET_RAD_S + _BIAS_SIGMAS * bias_sigma)
