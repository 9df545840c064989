"""Start-up: the first frame, and the state that the backend starts from.

The first scan comes without a speed. It is compensated for rotation only at first, and once more when the first step
has been found. The backend starts at the second frame, because the samples up to it give the direction of gravity.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.odometry.names import WITHOUT_IMU
from hybridlio.odometry.pipeline import Pipeline
from hybridlio.sources.late_start import LateStart, starts_late
from hybridlio.sources.scan_matching import ScanMatching

_LEVELLING_NS = NS_PER_S  # samples this long before the first scan help to find the direction of gravity


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
