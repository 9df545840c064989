"""Start-up: the first frame, the first step, and an IMU whose samples start after the scans.

The first scan comes without a speed. It is compensated for rotation only at first, and once more when the first step
has been found. The backend starts at the second frame, because the samples up to it give the direction of gravity.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RefinesAgain, RelativePose, State
from hybridlio.core.motion_limits import BRIDGED_ACCELERATION_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.odometry.pipeline import Pipeline, timed
from hybridlio.odometry.second_pass import second_compensation, without_misfit
from hybridlio.odometry.start_search import StartEstimate, StartSearch
from hybridlio.record import plain_values
from hybridlio.record.record import Record
from hybridlio.registration.cost_profile import PROBE_STEP_M
from hybridlio.sources.recent_points import repeats_pattern
from hybridlio.sources.scan_matching import LOST_COST, ScanMatching

_log = logging.getLogger(__name__)

# How often the first step is repeated without an IMU. The first answer comes from a coarse search over rotations too;
# after three repetitions, each from the answer before, it no longer changes.
_REPETITIONS_WITHOUT_IMU = 3
_LEVELLING_NS = NS_PER_S  # samples this long before the first scan help to find the direction of gravity
# Of a platform at rest: standard deviations of its samples within a step, over those of consumer IMUs (0.003 rad/s and
# 0.03 m/s² at 200 Hz) and a standing person's tremor, and below those of a walk (from 0.3 m/s²) or of motors.
_QUIET_RAD_S, _QUIET_M_S2, _FEWEST_QUIET, _BIAS_SIGMAS = 0.02, 0.15, 5, 3.0
_REST_M_S = 0.1  # 1 cm at 10 Hz, the error of a step; a standing person sways by less
_MOST_LEVEL = 0.5  # sine of the angle between an open direction and the vertical
_ANY_TURN_RAD = 10.0


def start_residual(pipeline: Pipeline) -> None:
    """Give the first scan to the residual source.

    It is compensated for its rotation alone, because its speed is unknown. The second scan is compensated no better by
    its first initial pose: two scans that the same speed has distorted fit each other, while one with and one without
    that distortion would end centimetres and milliradians apart.

    Raises:
        DataError: the source cannot start at this scan.
    """
    first, stamp_ns = pipeline.first, pipeline.first.scan.stamp_ns
    pipeline.residual.start(
        pipeline.compensation.compensate(first, np.eye(4), stamp_ns - NS_PER_S, stamp_ns, None, ImuSamples.empty())
    )


def start_backend(pipeline: Pipeline, second: Frame) -> State:
    """Start the backend at the first scan and return the state there.

    Gravity comes from the samples of the last second before the first scan and those up to the second one.

    Raises:
        DataError: the samples hold no specific force.
    """
    first = pipeline.first
    before = ImuSamples.empty()
    if len(first.imu):
        before = first.imu.between(first.scan.stamp_ns - _LEVELLING_NS, first.scan.stamp_ns)
    samples = ImuSamples.concatenate([before, second.imu])
    pipeline.start = start_state(first.scan.stamp_ns, samples, pipeline.imu_noise)
    pipeline.backend.start(pipeline.start)
    return pipeline.start


def measure_step(
    pipeline: Pipeline, frame: Frame, initial: RelativePose, before: State, seconds: dict[str, float]
) -> tuple[Frame, RelativePose]:
    """Return the compensated frame and the step to it: of the search of the start, if there is one, else refined.

    Lidars that do not repeat their pattern start by the search. Those that do, start by two scans; if these do not fit
    each other, and their match has not converged, the search leads; if it has, or if they leave a direction open, such
    as the vertical between walls, it goes along and mends it.

    Args:
        pipeline: its residual source refines.
        frame: as recorded.
        initial: initial relative pose of the step.
        before: the backend's state at the scan before.
        seconds: gets the time spent.
    """
    compensated, step = _measured(pipeline, frame, initial, before, seconds)
    return compensated, held_at_rest(pipeline.calibration, frame, step, before)


def _measured(
    pipeline: Pipeline, frame: Frame, initial: RelativePose, before: State, seconds: dict[str, float]
) -> tuple[Frame, RelativePose]:
    residual, is_first_step = pipeline.residual, pipeline.state is None
    repeats = not is_first_step or repeats_pattern(pipeline.first.scan, frame.scan)
    if not repeats and isinstance(residual, ScanMatching):
        pipeline.start_search = _search(pipeline, residual, leads=True)
    search = pipeline.start_search
    if search is not None and search.leads:
        found = _searched(pipeline, search, frame, seconds)
        if found is not None:
            return found
    answer = pipeline.refine(frame, initial, before, seconds)
    if is_first_step:
        answer = repeat_first_step(pipeline, frame, answer, before)
        fits_poorly = answer[1].details.get("cost", 0.0) > LOST_COST
        # Ghosts and few rings make a right match poor, too, but it converges; false ones in rooms do not.
        is_lost = not answer[1].ok or (fits_poorly and not answer[1].details.get("converged", 1.0))
        if isinstance(residual, ScanMatching) and (is_lost or fits_poorly or len(answer[1].degenerate)):
            pipeline.start_search = _search(pipeline, residual, leads=is_lost)
    elif isinstance(residual, RefinesAgain):
        second = second_compensation(frame, initial, answer[1], before, pipeline.calibration, pipeline.imu_noise)
        if second is not None:
            again = initial if len(frame.imu) else replace(initial, proposed=answer[1].pose)
            answer = pipeline.refine_again(frame, again, before, second)
        answer = answer[0], without_misfit(residual, initial, answer[1], LOST_COST)
    if pipeline.start_search is not None:
        own = None if pipeline.start_search.leads else _pose_after(pipeline, before, answer[1])
        return _searched(pipeline, pipeline.start_search, frame, seconds, own) or answer
    return answer


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
    up = (before.T_world_imu[:3, :3] @ calibration.T_imu_lidar[:3, :3]).T @ before.gravity_m_s2
    level = np.eye(3) - np.outer(up, up) / (up @ up)
    rest_m = _REST_M_S * (frame.scan.stamp_ns - before.stamp_ns) / NS_PER_S
    if (
        np.linalg.norm(level @ step.pose[:3, 3]) > rest_m
        or np.linalg.norm(step.degenerate[:, 3:] @ level, axis=1).max() > _MOST_LEVEL
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


def _search(pipeline: Pipeline, residual: ScanMatching, leads: bool) -> StartSearch:
    return StartSearch(pipeline.first, residual.settings, pipeline.calibration, pipeline.imu_noise, leads)


def restore_search(pipeline: Pipeline, state: Mapping[str, Any] | None) -> None:
    """Restore an unfinished search from its stored attributes; the residual source is restored already."""
    if state is not None and isinstance(pipeline.residual, ScanMatching):
        pipeline.start_search = _search(pipeline, pipeline.residual, leads=False)
        plain_values.restore(pipeline.start_search, state)


def _searched(
    pipeline: Pipeline, search: StartSearch, frame: Frame, seconds: dict[str, float], own: Array | None = None
) -> tuple[Frame, RelativePose] | None:
    """Return the search's answer, and give its scans to scan matching when it ends; None if it has no answer.

    A search that does not lead answers only when it has decided, and for another minimum than the run's own pose
    ``own`` ``(4, 4)`` of the scan in the frame of the first: in the same one, each scan's own match is the finer one.
    """
    assert pipeline.start is not None
    assert isinstance(pipeline.residual, ScanMatching)
    with timed(seconds, "residual"):
        found = search.add(frame, pipeline.start, pipeline.residual.name)
        is_news = own is None or (found is not None and _is_elsewhere(found, own))
        if found is None or found.is_decided or found.is_last:
            pipeline.start_search = None
            last = search.last if search.leads else found
            if last is not None and is_news and (search.leads or last.is_decided):
                pipeline.residual.start_from(last.frames, last.poses)
    if found is None or not is_news or not (search.leads or found.is_decided):
        return None
    return found.frames[-1], found.relative


def _pose_after(pipeline: Pipeline, before: State, step: RelativePose) -> Array:
    """Return the scan's pose in the frame of the first scan, by the run's own step."""
    assert pipeline.start is not None
    T_imu_lidar = pipeline.calibration.T_imu_lidar
    T_first_before = se3.between(pipeline.start.T_world_imu @ T_imu_lidar, before.T_world_imu @ T_imu_lidar)
    return T_first_before @ step.pose


def _is_elsewhere(found: StartEstimate, own: Array) -> bool:
    """Return whether the scan lies, by its median point, farther from a pose than two minima can be told apart."""
    points = found.frames[-1].scan.points
    apart = se3.transform(se3.between(found.poses[0], found.poses[-1]), points) - se3.transform(own, points)
    return bool(np.median(np.linalg.norm(apart, axis=1)) > PROBE_STEP_M)


def repeat_first_step(
    pipeline: Pipeline, second: Frame, found: tuple[Frame, RelativePose], start: State
) -> tuple[Frame, RelativePose]:
    """Repeat the first step now that its motion is known, and return it as :meth:`Pipeline.refine` does.

    The first scan is compensated again, with the speed that was found, and both scans with the gyroscope's bias that it
    shows: later scans are compensated so, and would otherwise lie turned by the bias over half a sweep. Without an IMU
    the rotation was unknown too and was searched for on a coarse grid; repeating the step from the answer improves it
    even where scans need no compensation.
    """
    first, (compensated, relative) = pipeline.first, found
    if start.has_imu and relative.ok:
        start = _with_turn_rate(pipeline, second, relative, start)
    repetitions = int(pipeline.compensation.applies_to(first)) if start.has_imu else _REPETITIONS_WITHOUT_IMU
    for _ in range(repetitions):
        if not relative.ok:
            break
        pipeline.residual.start(
            pipeline.compensation.compensate(
                first, relative.pose, first.scan.stamp_ns, second.scan.stamp_ns, start, second.imu
            )
        )
        compensated, relative = pipeline.refine(second, relative, start, {})
    return compensated, relative


def _with_turn_rate(pipeline: Pipeline, second: Frame, found: RelativePose, start: State) -> State:
    """Return the start with the gyroscope's bias by the rotation of the first step, weighed with what is assumed."""
    predicted = pipeline.setup.predict_from_imu(second, start)
    if predicted is None:
        return start
    step_s, R = (second.scan.stamp_ns - start.stamp_ns) / NS_PER_S, pipeline.calibration.T_imu_lidar[:3, :3]
    rate_error = R @ se3.log(se3.between(predicted.pose, found.pose))[:3] / step_s
    variance = np.eye(3) * pipeline.imu_noise.gyro_bias_sigma_rad_s**2
    gain = variance @ np.linalg.inv(variance + R @ found.covariance[:3, :3] @ R.T / step_s**2)
    return replace(start, gyro_bias_rad_s=start.gyro_bias_rad_s - gain @ rate_error)


def take_up_imu(pipeline: Pipeline, record: Record, frame: Frame) -> State:
    """Restart the backend when the first IMU samples come after some steps, and return the state at the last scan.

    The samples give the direction of gravity, which the backend needs at its start. It then gets all steps of the run
    so far again; to the graph, the run is one with a gap in its inertial data at the beginning.

    Args:
        pipeline: its state is at the last scan, without IMU.
        record: the run so far; one step or more.
        frame: the next frame, which carries the first samples.

    Raises:
        GraphError: the graph cannot be solved.
    """
    assert pipeline.state is not None
    _log.warning("frame %d: IMU samples start here; the scans before had none", frame.index)
    R_world_imu = pipeline.state.T_world_imu[:3, :3]
    in_world = replace(
        frame.imu, accel_m_s2=frame.imu.accel_m_s2 @ R_world_imu.T, gyro_rad_s=frame.imu.gyro_rad_s @ R_world_imu.T
    )
    start = before = now = start_state(record.start.stamp_ns, in_world, record.imu_noise)
    pipeline.backend.start(start)
    no_points, stamps_ns = np.empty((0, 3), np.float32), record.online.stamps_ns.tolist()
    for k, (stamp_ns, relative) in enumerate(zip(stamps_ns[1:], record.relative, strict=True), start=1):
        step = Frame(k, Scan(stamp_ns, no_points), ImuSamples.empty(), calibration=frame.calibration)
        before, now = now, pipeline.backend.update(step, relative)
    pipeline.start, pipeline.state = start, _with_mean_velocity(now, before)
    return pipeline.state


def _with_mean_velocity(now: State, before: State) -> State:
    """Return ``now`` with the mean velocity since ``before``; the graph has no velocity of its own without samples."""
    dt_s = (now.stamp_ns - before.stamp_ns) / NS_PER_S
    covariance = now.covariance.copy()
    covariance[6:9] = covariance[:, 6:9] = 0.0
    covariance[6:9, 6:9] = np.eye(3) * (BRIDGED_ACCELERATION_SIGMA_M_S2 * dt_s) ** 2
    velocity = (now.T_world_imu[:3, 3] - before.T_world_imu[:3, 3]) / dt_s
    return replace(now, velocity_m_s=velocity, covariance=covariance)
