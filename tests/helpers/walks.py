"""Stretches of simulated recordings of other platforms, in memory, with their true poses."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.recording import plan


def walk(config: PlatformConfig, first: int = 0, count: int = 10) -> Sequence:
    """Return ``count`` scans of a recording from scan ``first`` on."""
    recording = plan(config)
    stamps = recording.scan_stamps_ns[first : first + count]
    truth = recording.lidar_poses((stamps - START_NS) / NS_PER_S)
    return Sequence(
        config.name,
        stamps,
        lambda k: recording.scan(first + k),
        imu=recording.imu_samples(),
        calibration=Calibration(recording.T_imu_lidar),
        reference=Trajectory(stamps, truth).from_first(),
    )


def estimated(frames: list[Frame]) -> list[Estimate]:
    """Return the estimates of a run with default settings."""
    odometry = Odometry()
    return [odometry.step(frame) for frame in frames]


def errors_of(estimates: list[Estimate], truth: Trajectory | None) -> list[Array]:
    """Return the tangent vectors ``(6,)`` from the estimates to the true poses."""
    assert truth is not None
    return [se3.log(se3.between(one.pose, pose)) for one, pose in zip(estimates, truth.poses, strict=True)]


def squared_position_errors(estimates: list[Estimate], errors: list[Array]) -> Array:
    """Return the normalised squared errors of the positions ``(N,)``, per axis."""
    pairs = zip(estimates, errors, strict=True)
    return np.array([e[3:] @ np.linalg.solve(one.covariance[3:, 3:], e[3:]) / 3 for one, e in pairs])
