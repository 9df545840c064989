"""Measured steps: the first by the rules of a start, later ones by registration, twice where that moves points.

A start is one of three kinds. Two scans that fit each other make the first step, repeated until the motion that
compensates the scans is the one that they show. Where they do not, a search over several scans leads or goes along
(:mod:`hybridlio.odometry.start.start_search`). Where the IMU wakes up after the lidar, the first scan is placed by the
first one that samples cover.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import EarlierScanPose, RefinesAgain, RelativePose, State, TakesBack
from hybridlio.core.motion_limits import POINT_LEVER_M
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples
from hybridlio.odometry.pipeline import Pipeline, timed
from hybridlio.odometry.second_pass import held_at_rest, second_compensation, without_misfit
from hybridlio.odometry.start.false_start import turns_elsewhere
from hybridlio.odometry.start.start_search import StartEstimate, StartSearch
from hybridlio.record import plain_values
from hybridlio.sources.late_start import LateStart, less_certain
from hybridlio.sources.recent_points import FEWEST_POINTS, repeats_directions, repeats_rows
from hybridlio.sources.scan_matching import LOST_COST, ScanMatching
from hybridlio.sources.thinned_scan import thin

# How often the first step is repeated without an IMU. The first answer comes from a coarse search over rotations too;
# after three repetitions, each from the answer before, it no longer changes.
_REPETITIONS_WITHOUT_IMU = 3
# With an IMU until the answer changes by less than that at the distance of half of a scan's points.
_MOST_REPETITIONS, _SETTLED_M = 6, 0.01
# Of a first turn by two scans that fit each other: 1.1°, which displaces points 10 m away by two default kernels. In 44
# recordings of rooms, roads and woods it is at most 0.7° off, and 16° where the scans fit each other wrongly.
_TURN_SIGMA_RAD = 0.02
# Beside where several scans place a scan, its own match is another minimum, with points off the surfaces. With half a
# metre an office (16 beams) starts 0.3 m too high with σ 3 cm; otherwise 131 starts of all scenes hardly change.
_ELSEWHERE_KERNELS = 2.0
_LONGEST_WITHOUT_IMU_NS = 2 * NS_PER_S  # after which the first scan is given up: later ones no longer see what it saw
_PLACING_ROUNDS = 3  # of placing the first scan, which gives the speed that the second is compensated by


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
    is_first_step = pipeline.state is None
    if is_first_step:
        _learn_pattern(pipeline, frame)
    search = pipeline.start_search
    if search is not None and search.leads:
        found = _searched(pipeline, search, frame, seconds)
        if found is not None:
            return found
    registered = _first if is_first_step else _registered
    answer = registered(pipeline, frame, initial, before, seconds)
    if pipeline.late_start is not None:
        answer = _with_late_imu(pipeline, pipeline.late_start, frame, answer, before)
    if pipeline.start_search is not None:
        own = None if pipeline.start_search.leads else pipeline.pose_after(before, answer[1])
        return _searched(pipeline, pipeline.start_search, frame, seconds, own) or answer
    return answer


def _learn_pattern(pipeline: Pipeline, second: Frame) -> None:
    """Tell scan matching whether the lidar repeats its pattern; if not, a search leads the start."""
    residual, first = pipeline.residual, pipeline.first
    if not isinstance(residual, ScanMatching) or min(len(first.scan), len(second.scan)) < FEWEST_POINTS:
        return
    repeats = repeats_directions(first.scan, second.scan)
    residual.recent.tell(repeats)
    if not (repeats or repeats_rows(first.scan, second.scan)):
        pipeline.start_search = _search_of(pipeline, residual, leads=True)


def _first(
    pipeline: Pipeline, second: Frame, initial: RelativePose, before: State, seconds: dict[str, float]
) -> tuple[Frame, RelativePose]:
    """Return the first step by two scans, and begin a search where these do not fit, or leave a direction open."""
    if pipeline.late_start is not None and before.has_imu:
        _restart_at(pipeline, second, initial.pose, before)
    answer = pipeline.refine(second, initial, before, seconds)
    fitted, answer = not _fits_poorly(answer[1]), _repeat_first_step(pipeline, second, initial, answer, before)
    residual, step = pipeline.residual, answer[1]
    fits_poorly = _fits_poorly(step)
    # Ghosts and few rings make a right match poor, too, but it converges, and was poor before it was repeated.
    is_lost = not step.ok or (fits_poorly and (fitted or not step.details.get("converged", 1.0)))
    is_lost = is_lost or (initial.from_imu and turns_elsewhere(initial, step, _TURN_SIGMA_RAD))
    if isinstance(residual, ScanMatching) and (is_lost or fits_poorly or len(step.degenerate)):
        pipeline.start_search = _search_of(pipeline, residual, leads=is_lost)
    return answer


def _registered(
    pipeline: Pipeline, frame: Frame, initial: RelativePose, before: State, seconds: dict[str, float]
) -> tuple[Frame, RelativePose]:
    """Return a later step, registered a second time where its own motion compensates the scan otherwise."""
    compensated, step = pipeline.refine(frame, initial, before, seconds)
    residual = pipeline.residual
    if not isinstance(residual, RefinesAgain):
        return compensated, step
    weighs = initial.from_imu and not pipeline.gate.is_warming_up
    second = second_compensation(frame, initial, step, before, pipeline.calibration, pipeline.imu_noise, weighs)
    if second is not None:
        again = initial if len(frame.imu) else replace(initial, proposed=step.pose)
        compensated, step = pipeline.refine_again(frame, again, before, second)
    return compensated, without_misfit(residual, initial, step, LOST_COST)


def _fits_poorly(step: RelativePose) -> bool:
    return step.details.get("cost", 0.0) > LOST_COST


def _repeat_first_step(
    pipeline: Pipeline, second: Frame, initial: RelativePose, found: tuple[Frame, RelativePose], start: State
) -> tuple[Frame, RelativePose]:
    """Repeat the first step now that its motion is known, and return it as :meth:`Pipeline.refine` does.

    The first scan is compensated again, with the speed that was found, and both scans with the gyroscope's bias that it
    shows: later scans are compensated so, and would otherwise lie turned by the bias over half a sweep. Without an IMU
    the rotation was unknown too and was _searched for on a coarse grid; repeating the step from the answer improves it
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
    if is_late and relative.ok and isinstance(pipeline.residual, TakesBack) and turns_elsewhere(initial, relative):
        pipeline.residual.take_back(initial)
        relative = replace(initial, details=relative.details)
    return compensated, relative


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


def _search_of(pipeline: Pipeline, residual: ScanMatching, leads: bool) -> StartSearch:
    """Return a new search from the run's first scan; one that leads is believed before each scan's own match."""
    repeats = residual.recent.repeats
    return StartSearch(pipeline.first, residual.settings, pipeline.calibration, pipeline.imu_noise, repeats, leads)


def restore_search(pipeline: Pipeline, state: Mapping[str, Any] | None) -> None:
    """Restore an unfinished search from its stored attributes; the residual source is restored already."""
    if state is not None and isinstance(pipeline.residual, ScanMatching):
        pipeline.start_search = _search_of(pipeline, pipeline.residual, leads=False)
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
        apart_m = _ELSEWHERE_KERNELS * pipeline.residual.settings.registration.kernel_m
        is_news = own is None or (found is not None and _is_elsewhere(found, own, apart_m))
        if found is None or found.is_decided or found.is_last:
            pipeline.start_search = None
            last = search.last if search.leads else found
            if last is not None and is_news and (search.leads or last.is_decided):
                pipeline.residual.start_from(last.frames, last.poses)
    if found is None or not is_news or not (search.leads or found.is_decided):
        return None
    return found.frames[-1], found.relative


def _is_elsewhere(found: StartEstimate, own: Array, apart_m: float) -> bool:
    """Return whether the scan lies, by its median point, farther from a pose than ``apart_m``."""
    points = found.frames[-1].scan.points
    apart = se3.transform(se3.between(found.poses[0], found.poses[-1]), points) - se3.transform(own, points)
    return bool(np.median(np.linalg.norm(apart, axis=1)) > apart_m)


def _with_late_imu(
    pipeline: Pipeline, late: LateStart, frame: Frame, answer: tuple[Frame, RelativePose], before: State
) -> tuple[Frame, RelativePose]:
    """Return a step with what is known of the first scan: placed by this scan if samples cover it, else uncertain.

    Args:
        pipeline: its late start ends with the first scan that is covered, and when the first scan is given up.
        late: that late start.
        frame: as recorded.
        answer: the compensated frame, and the step to it.
        before: the backend's state at the scan before.
    """
    is_covered = before.has_imu and _is_covered(frame)
    if is_covered or frame.scan.stamp_ns - late.frame.scan.stamp_ns > _LONGEST_WITHOUT_IMU_NS:
        pipeline.late_start = None
    if not answer[1].ok:
        return answer
    placed = _placed(pipeline, late, frame, answer, before) if is_covered else None
    if placed is not None:
        return placed
    if pipeline.state is not None:
        return answer
    samples = late.first_samples(frame)
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
    for _ in range(_PLACING_ROUNDS if is_first_step else 1):
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
