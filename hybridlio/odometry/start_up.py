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
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.estimates import EarlierScanPose, RefinesAgain, RelativePose, State, TakesBack
from hybridlio.core.motion_limits import POINT_LEVER_M
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.odometry.names import WITHOUT_IMU
from hybridlio.odometry.pipeline import Pipeline, timed
from hybridlio.odometry.second_pass import held_at_rest, second_compensation, without_misfit
from hybridlio.odometry.start_search import StartEstimate, StartSearch
from hybridlio.record import plain_values
from hybridlio.registration.cost_profile import PROBE_STEP_M
from hybridlio.sources.late_start import LateStart, less_certain, starts_late
from hybridlio.sources.recent_points import repeats_directions, repeats_pattern
from hybridlio.sources.scan_matching import LOST_COST, ScanMatching
from hybridlio.sources.thinned_scan import thin

_log = logging.getLogger(__name__)

# How often the first step is repeated without an IMU. The first answer comes from a coarse search over rotations too;
# after three repetitions, each from the answer before, it no longer changes.
_REPETITIONS_WITHOUT_IMU = 3
# With an IMU until the answer changes by less than that at the distance of half of a scan's points.
_MOST_REPETITIONS, _SETTLED_M = 6, 0.01
_EXCLUDED_TURN = chi_square_quantile(0.999, 3)
_LEVELLING_NS = NS_PER_S  # samples this long before the first scan help to find the direction of gravity
_LONGEST_NS = 2 * NS_PER_S  # after which the first scan is given up: later ones no longer see what it saw
_ROUNDS = 3  # of placing the first scan, which gives the speed that the second is compensated by


def start_residual(pipeline: Pipeline) -> None:
    """Give the first scan to the residual source.

    It is compensated for its rotation alone, because its speed is unknown. The second scan is compensated no better by
    its first initial pose: two scans that the same speed has distorted fit each other, while one with and one without
    that distortion would end centimetres and milliradians apart.

    Raises:
        DataError: the source cannot start at this scan.
    """
    first, stamp_ns = pipeline.first, pipeline.first.scan.stamp_ns
    compensated = pipeline.compensation.compensate(
        first, np.eye(4), stamp_ns - NS_PER_S, stamp_ns, None, ImuSamples.empty()
    )
    pipeline.residual.start(compensated)
    awaits_imu = pipeline.initial_pose.name not in WITHOUT_IMU
    if awaits_imu and isinstance(pipeline.residual, ScanMatching) and starts_late(first):
        pipeline.late_start = LateStart(first, compensated)


def start_backend(pipeline: Pipeline, second: Frame) -> State:
    """Start the backend at the first scan and return the state there.

    Gravity comes from the samples of the last second before the first scan and those up to the second one; where the
    samples start later, from those of the second sweep.

    Raises:
        DataError: the samples hold no specific force.
    """
    first = pipeline.first
    before = ImuSamples.empty()
    if len(first.imu):
        before = first.imu.between(first.scan.stamp_ns - _LEVELLING_NS, first.scan.stamp_ns)
    samples = ImuSamples.concatenate([before, second.imu if len(second.imu) else second.sweep_imu])
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
    if is_first_step and isinstance(residual, ScanMatching):
        residual.recent.tell(repeats_directions(pipeline.first.scan, frame.scan))
        if not repeats_pattern(pipeline.first.scan, frame.scan):
            pipeline.start_search = _search(pipeline, residual, leads=True)
    search = pipeline.start_search
    if search is not None and search.leads:
        found = _searched(pipeline, search, frame, seconds)
        if found is not None:
            return found
    if is_first_step and pipeline.late_start is not None and before.has_imu:
        _restart_at(pipeline, frame, initial.pose, before)
    answer = pipeline.refine(frame, initial, before, seconds)
    if is_first_step:
        fitted, answer = not _fits_poorly(answer[1]), repeat_first_step(pipeline, frame, initial, answer, before)
        fits_poorly = _fits_poorly(answer[1])
        # Ghosts and few rings make a right match poor, too, but it converges, and was poor before it was repeated.
        is_lost = not answer[1].ok or (fits_poorly and (fitted or not answer[1].details.get("converged", 1.0)))
        if isinstance(residual, ScanMatching) and (is_lost or fits_poorly or len(answer[1].degenerate)):
            pipeline.start_search = _search(pipeline, residual, leads=is_lost)
    elif isinstance(residual, RefinesAgain):
        second = second_compensation(frame, initial, answer[1], before, pipeline.calibration, pipeline.imu_noise)
        if second is not None:
            again = initial if len(frame.imu) else replace(initial, proposed=answer[1].pose)
            answer = pipeline.refine_again(frame, again, before, second)
        answer = answer[0], without_misfit(residual, initial, answer[1], LOST_COST)
    if pipeline.late_start is not None:
        answer = _with_late_imu(pipeline, frame, answer, before)
    if pipeline.start_search is not None:
        own = None if pipeline.start_search.leads else pipeline.pose_after(before, answer[1])
        return _searched(pipeline, pipeline.start_search, frame, seconds, own) or answer
    return answer


def _fits_poorly(step: RelativePose) -> bool:
    return step.details.get("cost", 0.0) > LOST_COST


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


def _is_elsewhere(found: StartEstimate, own: Array) -> bool:
    """Return whether the scan lies, by its median point, farther from a pose than two minima can be told apart."""
    points = found.frames[-1].scan.points
    apart = se3.transform(se3.between(found.poses[0], found.poses[-1]), points) - se3.transform(own, points)
    return bool(np.median(np.linalg.norm(apart, axis=1)) > PROBE_STEP_M)


def repeat_first_step(
    pipeline: Pipeline, second: Frame, initial: RelativePose, found: tuple[Frame, RelativePose], start: State
) -> tuple[Frame, RelativePose]:
    """Repeat the first step now that its motion is known, and return it as :meth:`Pipeline.refine` does.

    The first scan is compensated again, with the speed that was found, and both scans with the gyroscope's bias that it
    shows: later scans are compensated so, and would otherwise lie turned by the bias over half a sweep. Without an IMU
    the rotation was unknown too and was searched for on a coarse grid; repeating the step from the answer improves it
    even where scans need no compensation.
    """
    compensated, relative = found
    is_late = start.has_imu and pipeline.late_start is not None
    if start.has_imu and relative.ok and not is_late:
        start = _with_turn_rate(pipeline, second, relative, start)
    repetitions = _MOST_REPETITIONS * int(pipeline.compensation.applies_to(pipeline.first))
    for _ in range(repetitions if start.has_imu else _REPETITIONS_WITHOUT_IMU):
        if not relative.ok:
            break
        before = relative
        if is_late and len(second.imu):  # scans that are compensated alike fit each other whatever the turn
            before = replace(relative, pose=se3.make(initial.pose[:3, :3], relative.pose[:3, 3]))
        _restart_at(pipeline, second, before.pose, start)
        compensated, relative = pipeline.refine(second, before, start, {})
        moved = np.linalg.norm(se3.log(se3.between(before.pose, relative.pose)).reshape(2, 3), axis=1)
        if start.has_imu and moved @ (POINT_LEVER_M, 1.0) < _SETTLED_M:
            break
    if is_late and relative.ok and isinstance(pipeline.residual, TakesBack) and _turns_elsewhere(initial, relative):
        pipeline.residual.take_back(initial)
        relative = replace(initial, details=relative.details)
    return compensated, relative


def _turns_elsewhere(initial: RelativePose, found: RelativePose) -> bool:
    """Return whether a step turns by what its initial pose excludes."""
    apart = se3.so3_log(initial.pose[:3, :3].T @ found.pose[:3, :3])
    return bool(apart @ np.linalg.solve(initial.covariance[:3, :3], apart) > _EXCLUDED_TURN)


def _restart_at(pipeline: Pipeline, second: Frame, step: Array, start: State) -> None:
    """Give the first scan to the residual source again, compensated by the step ``(4, 4)`` to the second."""
    first, samples = pipeline.first, ImuSamples.concatenate([second.imu, second.sweep_imu])
    stamps_ns = first.scan.stamp_ns, second.scan.stamp_ns
    compensated = pipeline.compensation.compensate(first, step, *stamps_ns, start, samples)
    pipeline.residual.start(compensated)
    if pipeline.late_start is not None:
        pipeline.late_start = LateStart(first, compensated)


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


def _with_late_imu(
    pipeline: Pipeline, frame: Frame, answer: tuple[Frame, RelativePose], before: State
) -> tuple[Frame, RelativePose]:
    """Return a step with what is known of the first scan: placed by this scan if samples cover it, else uncertain.

    Args:
        pipeline: it has a late start.
        frame: as recorded.
        answer: the compensated frame, and the step to it.
        before: the backend's state at the scan before.
    """
    late = pipeline.late_start
    assert late is not None
    samples, is_covered = late.first_samples(frame), before.has_imu and _is_covered(frame)
    if is_covered or frame.scan.stamp_ns - late.frame.scan.stamp_ns > _LONGEST_NS:
        pipeline.late_start = None
    placed = _placed(pipeline, late, frame, answer, before) if is_covered and answer[1].ok else None
    if placed is not None or pipeline.state is not None or not answer[1].ok:
        return placed or answer
    noise = late.noise(samples) if before.has_imu and len(samples) else late.noise_without_samples()
    return answer[0], less_certain(answer[1], noise)


def _placed(
    pipeline: Pipeline, late: LateStart, frame: Frame, answer: tuple[Frame, RelativePose], before: State
) -> tuple[Frame, RelativePose] | None:
    """Place the first scan by a covered one, which starts the map anew; None if it does not fit."""
    assert isinstance(pipeline.residual, ScanMatching)
    (compensated, step), is_first_step = answer, pipeline.state is None
    T_first_scan, settings = pipeline.pose_after(before, step), pipeline.residual.settings
    covariance = np.zeros((6, 6))
    for _ in range(_ROUNDS if is_first_step else 1):
        surface, guess = thin(compensated.scan, settings).surface, se3.inverse(T_first_scan)
        found = late.placed(settings, surface, late.first_samples(frame), guess, LOST_COST)
        if found is None:
            return None
        T_first_scan, covariance = se3.inverse(found.pose), se3.rotate_covariance(found.covariance, found.pose)
        if is_first_step:
            compensated = pipeline.compensated(frame, T_first_scan, before)
    pipeline.residual.start(compensated)
    if is_first_step:
        return compensated, replace(step, pose=T_first_scan, covariance=covariance, drift=None)
    earlier = EarlierScanPose(pipeline.first.scan.stamp_ns, T_first_scan, covariance + late.noise_of_speed(before))
    wide = step.wider(added=late.noise(late.first_samples(frame)))
    return compensated, replace(wide, drift=None, earlier_scans=(earlier,))


def _is_covered(frame: Frame) -> bool:
    """Return whether samples cover the whole sweep."""
    offsets_ns, imu = frame.scan.time_offsets_ns, frame.sweep_imu
    if offsets_ns is None or not len(imu) or not len(frame.imu):
        return False
    return bool(imu.stamps_ns[0] <= frame.scan.stamp_ns + offsets_ns.min())
