"""Offline smoothing: a run's factors optimised together, from its record alone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X
from numpy.typing import ArrayLike

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import State
from hybridlio.core.progress import Progress
from hybridlio.core.trajectory import Trajectory
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.base.marginals import Marginals, pose_covariances
from hybridlio.graph.base.preintegration import covers, makes_one_factor, preintegrate
from hybridlio.graph.run import factors
from hybridlio.graph.run.factor_groups import FactorGroup
from hybridlio.graph.run.gps_factors import GpsGroup
from hybridlio.graph.run.kind_fits import kind_fits
from hybridlio.graph.run.loop_factors import LoopClosures
from hybridlio.graph.run.robust import AddedGroups, check_robust_method
from hybridlio.graph.run.run_calibration import RunCalibration
from hybridlio.graph.run.scan_numbers import ScanNumbers
from hybridlio.graph.run.wheel_factors import wheel_groups
from hybridlio.record.inputs import Fixes, Odometry, OdometryInputs, record_of
from hybridlio.record.record import Record
from hybridlio.smoothing.calibration import CalibrationPriors
from hybridlio.smoothing.gps_options import GpsOptions
from hybridlio.smoothing.loops import given_loops
from hybridlio.smoothing.smoothed import Smoothed
from hybridlio.smoothing.verdict import Verdict

if TYPE_CHECKING:
    from hybridlio.smoothing.loop_closure import LoopSettings

Loops: TypeAlias = "Sequence[tuple[int, int, ArrayLike, ArrayLike]]"

_log = logging.getLogger(__name__)

_SCANS_AND_FIXES = frozenset(map(ord, "xvbgmawp"))  # letters of the keys that each scan, or each GPS fix, has one of
_ITERATIONS_A_STEP = 4  # while outliers are rejected: each step of GNC repeats until it converges anyway
_RELATIVE_TOLERANCE = 1e-6  # decrease of the error at which iterations stop; a tenth of GTSAM's default


def smooth(
    odometry: Odometry,
    progress: Progress | None = None,
    *,
    loops: bool | LoopSettings | Loops = False,
    gps: bool | GpsOptions | Fixes = False,
    groups: Sequence[FactorGroup] = (),
    robust: str | None = None,
    calibrate: Sequence[str] | CalibrationPriors = (),
    **inputs: Unpack[OdometryInputs],
) -> Smoothed:
    """Optimise all poses, velocities, biases and gravity of a run at once (Levenberg-Marquardt).

    Args:
        odometry: a run: its record, from :meth:`hybridlio.odometry.odometry.Odometry.record`, or its folder. Or poses
            of any odometry: a TUM, KITTI or EuRoC file, a trajectory, poses ``(N, 4, 4)`` with ``stamps``, or rows
            ``t_s, x, y, z, qx, qy, qz, qw``.
        progress: called with the stage, the steps done and the steps in total.
        loops: True, or settings, to find and close loops of a run with keyframes; or loops
            ``(i, j, T_i_j, covariance)`` of lidar poses, scans by row, which GNC may reject. ``found["loops"]`` is then
            a :class:`hybridlio.smoothing.loops.ClosedLoops`.
        gps: True, or options, to use the record's GPS fixes or those of ``fixes``; or the fixes themselves, as
            ``fixes`` takes them. ``found["gps"]`` is then a :class:`hybridlio.smoothing.gps_options.GpsFit`.
        groups: further measurements.
        robust: method against outliers among the measurements of all groups: ``huber``, ``cauchy``, ``geman-mcclure``,
            ``dcs`` or ``gnc``; None takes each group's default.
        calibrate: names of parameters to estimate as well, of ``time_offset`` and ``extrinsics`` (of IMU and lidar),
            ``lever_arm`` and ``gps_clock``; or a :class:`hybridlio.smoothing.calibration.CalibrationPriors`.
            ``found["calibration"]`` is then a :class:`hybridlio.smoothing.calibration.Calibrated`. What the motion does
            not determine stays as stated.
        inputs: ``wheels``, whose result is a :class:`hybridlio.graph.run.wheel_factors.WheelFit`, and beside poses
            ``imu``, ``fixes``, ``calibration``, ``covariances``, ``imu_noise``, ``imu_time_offset_s`` and ``stamps``,
            from files or arrays (:class:`hybridlio.record.inputs.OdometryInputs`).

    Raises:
        GraphError: the graph cannot be solved.
        EstimationError: too few fixes, or no wheel speeds, lie in the run's time.
        ConfigError: an unknown robust method or parameter, or a parameter without its sensor.
        DataError: loops are to be found, and the record has no keyframes; a file, array or loop is malformed.
    """
    report, robust = progress or _silent, check_robust_method(robust)  # checked before the long search for loops
    priors = calibrate if isinstance(calibrate, CalibrationPriors) else CalibrationPriors(calibrate)
    if not isinstance(gps, bool | GpsOptions):
        inputs["fixes"], gps = gps, True
    wheels = wheel_groups(inputs.pop("wheels", None))
    record = record_of(odometry, inputs, with_keyframes=loops is not False and not isinstance(loops, Sequence))
    priors.check_sensors(has_imu=record.start.has_imu, has_gps=bool(gps))
    options = gps if isinstance(gps, GpsOptions) else GpsOptions()
    fixes = [GpsGroup(record, options, priors.antenna_sigma_m)] if gps else []
    closures = _loop_closures(record, loops, report)
    added = AddedGroups([*fixes, *wheels, *groups, *closures], robust)
    calibration = RunCalibration(record, priors, fixes, closures)
    return on_deep_stack(len(record.online), lambda: _optimise(record, added, calibration, report))


def _optimise(record: Record, added: AddedGroups, calibration: RunCalibration, report: Progress) -> Smoothed:
    """Solve the run's graph with the added groups, in rounds."""
    states = _online_states(record)
    error_before: float | None = None
    for number in range(calibration.rounds):
        report("optimising", number, calibration.rounds)
        graph, values = _build(calibration.applied(), states)
        calibration.link(graph, values, states)
        own = graph.size()
        graph, values = added.add_to(graph, values, states, _few_iterations)
        error_before = graph.error(values) if error_before is None else error_before
        optimiser = _optimiser(graph, values, calibration.iterations)
        values = _solve(optimiser)
        states = _states(values, states)
        added.start_next_from(values)
        if calibration.take(graph, values):
            break
    marginals = Marginals(graph, values)
    covariances = pose_covariances(marginals, np.array([state.T_world_imu for state in states]), report)
    found = added.results(values, states, marginals.covariance)
    found |= calibration.results(values, marginals.covariance)
    verdict = Verdict.of(kind_fits(graph, own, values, added))
    for doubt in verdict.doubts:
        _log.warning("smoothing: %s", doubt)
    smoothed = _smoothed(calibration.applied(), states, covariances, error_before or 0.0, optimiser, found)
    converged = calibration.has_converged(smoothed.iterations)
    own_poses = _own_trajectory(record) if verdict.refused else {}
    clock_s, notes = record.imu_time_offset_s, record.notes
    return replace(smoothed, verdict=verdict, converged=converged, imu_time_offset_s=clock_s, notes=notes, **own_poses)


def _own_trajectory(record: Record) -> dict[str, Any]:
    """Return the odometry's own poses and steps, in place of a solution that contradicts them."""
    steps = np.array([step.covariance for step in record.relative])
    return {"trajectory": record.online, "step_covariances": steps}


def _loop_closures(record: Record, loops: bool | LoopSettings | Loops, report: Progress) -> list[LoopClosures]:
    if loops is False:
        return []
    if isinstance(loops, Sequence):
        return [LoopClosures(given_loops(loops, len(record.online)), record.calibration.T_imu_lidar)]
    from hybridlio.smoothing.loop_closure import find_loops  # late: only those who close loops load registration

    search = find_loops(record, None if loops is True else loops, report)
    return [LoopClosures(search, record.calibration.T_imu_lidar)]


def _silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""
    del stage, done, total


def _online_states(record: Record) -> list[State]:
    """States of the online estimate, with velocities from finite differences."""
    T = record.calibration.T_imu_lidar
    poses = T @ record.online.poses @ se3.inverse(T)
    times_s = record.online.times_s
    velocities = np.gradient(poses[:, :3, 3], times_s, axis=0) if len(poses) > 1 else np.zeros((1, 3))
    return [
        replace(record.start, stamp_ns=int(stamp), T_world_imu=pose, velocity_m_s=velocity)
        for stamp, pose, velocity in zip(record.online.stamps_ns, poses, velocities, strict=True)
    ]


def _build(record: Record, states: list[State]) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The factors of all steps, with biases and initial values of ``states``."""
    graph, _ = factors.start_factors(record.start)
    values = gtsam.Values()
    factors.insert_state(values, 0, states[0])
    scans = ScanNumbers(states[0].stamp_ns)
    for i, relative in enumerate(record.relative):
        state, stamp_ns = states[i], states[i + 1].stamp_ns
        imu = record.imu.between(state.stamp_ns, stamp_ns)
        usable = state.has_imu and covers(imu, state.stamp_ns, stamp_ns) and makes_one_factor(imu, state)
        pim = preintegrate(imu, state, record.imu_noise) if usable else None
        T_imu_lidar = record.calibration.T_imu_lidar
        graph.push_back(factors.step_factors(i, state, relative, pim, stamp_ns, T_imu_lidar, scans))
        factors.insert_step(values, i, state, states[i + 1], relative, scans)
        scans.add(stamp_ns, on_map_path=relative.drift is not None)
    return graph, values


def _optimiser(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int
) -> gtsam.LevenbergMarquardtOptimizer:
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky fails on long straight chains
    params.setRelativeErrorTol(_RELATIVE_TOLERANCE)
    params.setMaxIterations(iterations)
    # Variables that hundreds of factors share, such as the frame of GPS fixes, go last in COLAMD's order. On KITTI 00
    # with 1,407 variables of fixes, three iterations then take 2.0 s, and 28 s with those variables last as well.
    shared = [key for key in list(values.keys()) if gtsam.Symbol(key).chr() not in _SCANS_AND_FIXES]
    ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, shared)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, ordering, params)


def _solve(optimiser: gtsam.LevenbergMarquardtOptimizer) -> gtsam.Values:
    try:
        return optimiser.optimize()
    except RuntimeError as error:
        raise GraphError(f"smoothing: the graph cannot be solved: {gtsam_message(error)}") from error


def _states(values: gtsam.Values, states: list[State]) -> list[State]:
    return [_state(values, k, state) for k, state in enumerate(states)]


def _state(values: gtsam.Values, k: int, state: State) -> State:
    pose = values.atPose3(X(k)).matrix()
    if not state.has_imu:
        return replace(state, T_world_imu=pose)
    bias = values.atConstantBias(B(k))
    return replace(
        state,
        T_world_imu=pose,
        velocity_m_s=values.atVector(V(k)),
        accel_bias_m_s2=bias.accelerometer(),
        gyro_bias_rad_s=bias.gyroscope(),
        gravity_m_s2=values.atVector(G(k)),
    )


def _few_iterations(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    return _solve(_optimiser(graph, values, _ITERATIONS_A_STEP))


def _smoothed(
    record: Record,
    states: list[State],
    covariances: tuple[Array, Array],
    error_before: float,
    optimiser: gtsam.LevenbergMarquardtOptimizer,
    found: dict[str, Any],
) -> Smoothed:
    T = record.calibration.T_imu_lidar
    T_inv = se3.inverse(T)
    poses = T_inv @ np.array([state.T_world_imu for state in states]) @ T
    stamps = np.array([state.stamp_ns for state in states])
    iterations = int(optimiser.iterations())
    absolute, steps = (se3.rotate_covariance(part, T_inv) for part in covariances)
    return Smoothed(
        trajectory=Trajectory(stamps, se3.between(poses[0], poses), absolute),
        step_covariances=steps,
        velocities_m_s=np.array([state.velocity_m_s for state in states]),
        accel_biases_m_s2=np.array([state.accel_bias_m_s2 for state in states]),
        gyro_biases_rad_s=np.array([state.gyro_bias_rad_s for state in states]),
        gravity_m_s2=states[0].gravity_m_s2,
        error_before=error_before,
        error_after=float(optimiser.error()),
        iterations=iterations,
        converged=True,
        found=found,
    )
