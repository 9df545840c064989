"""An IMU that starts after the scans: the run so far becomes one that had a gap in its inertial data at the start."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from hybridlio.core.estimates import Backend, State
from hybridlio.core.motion_limits import BRIDGED_ACCELERATION_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.record.record import Record

_log = logging.getLogger(__name__)


def take_up_imu(backend: Backend, record: Record, frame: Frame, state: State) -> tuple[State, State]:
    """Start the backend again, now knowing where down is, and give it the steps that it has had.

    Args:
        backend: has all steps of ``record``.
        record: of the run so far; one step or more.
        frame: the next, which has the first samples.
        state: at the last scan.

    Returns:
        The first scan's state and the last one's. The graph is told of speed by later samples only; here the last
        one's is that of the last step.

    Raises:
        GraphError: the graph cannot be solved.
    """
    _log.warning("frame %d: inertial samples from here on; the scans so far had none", frame.index)
    R_world_imu = state.T_world_imu[:3, :3]
    in_world = replace(
        frame.imu, accel_m_s2=frame.imu.accel_m_s2 @ R_world_imu.T, gyro_rad_s=frame.imu.gyro_rad_s @ R_world_imu.T
    )
    start = before = now = start_state(record.start.stamp_ns, in_world, record.imu_noise)
    backend.start(start)
    nothing, stamps_ns = np.empty((0, 3), np.float32), record.online.stamps_ns.tolist()
    for k, (stamp_ns, relative) in enumerate(zip(stamps_ns[1:], record.relative, strict=True), start=1):
        step = Frame(k, Scan(stamp_ns, nothing), ImuSamples.empty(), calibration=frame.calibration)
        before, now = now, backend.update(step, relative)
    return start, _with_speed(now, before)


def _with_speed(now: State, before: State) -> State:
    """``now``, with the mean velocity since ``before``."""
    dt_s = (now.stamp_ns - before.stamp_ns) / NS_PER_S
    covariance = now.covariance.copy()
    covariance[6:9] = covariance[:, 6:9] = 0.0
    covariance[6:9, 6:9] = np.eye(3) * (BRIDGED_ACCELERATION_SIGMA_M_S2 * dt_s) ** 2
    velocity = (now.T_world_imu[:3, 3] - before.T_world_imu[:3, 3]) / dt_s
    return replace(now, velocity_m_s=velocity, covariance=covariance)
