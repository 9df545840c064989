"""An IMU whose samples start after some steps."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import BRIDGED_ACCELERATION_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.odometry.pipeline import Pipeline
from hybridlio.record.record import Record
from hybridlio.sources.late_start import less_certain

_log = logging.getLogger(__name__)


def take_up_imu(pipeline: Pipeline, record: Record, frame: Frame) -> State:
    """Restart the backend when the first IMU samples come after some steps, and return the state at the last scan.

    The samples give the direction of gravity, which the backend needs at its start. It then gets all steps of the run
    so far again; to the graph, the run is one with a gap in its inertial data at the beginning. The samples also show
    how rates change while scans are compensated by steps alone, which makes those steps less certain.

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
    steps, late = list(record.relative), pipeline.late_start
    if late is not None:
        pipeline.late_noise = late.noise(late.first_samples(frame))
    if pipeline.late_noise is not None:
        steps = [less_certain(steps[0], pipeline.late_noise), *(s.wider(added=pipeline.late_noise) for s in steps[1:])]
    for k, (stamp_ns, relative) in enumerate(zip(stamps_ns[1:], steps, strict=True), start=1):
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
