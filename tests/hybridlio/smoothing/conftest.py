"""Drives through towns of boxes that return to their streets; no rays are cast, so a drive takes a second."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.loop_keyframes import LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.record.record import Record
from hybridlio.smoothing.loop_closure import find_loops
from hybridlio.smoothing.loops import Loop, LoopSearch


@dataclass(frozen=True, eq=False)
class LoopDrive:
    """A drive that returns to its streets, without IMU; odometry has the noise that its covariances claim."""

    record: Record
    truth: Trajectory

    def error_of(self, loop: Loop) -> tuple[float, float]:
        """Error of a loop in metres and degrees."""
        poses = self.truth.poses
        wrong = se3.log(se3.between(loop.pose, se3.between(poses[loop.earlier], poses[loop.later])))
        return float(np.linalg.norm(wrong[3:])), float(np.rad2deg(np.linalg.norm(wrong[:3])))


def _town(rng: np.random.Generator, path: np.ndarray) -> np.ndarray:
    """Points ``(N, 3)`` on flat ground and on the walls of boxes, large and small, beside the path ``(M, 2)``."""
    low, high = path.min(axis=0) - 40.0, path.max(axis=0) + 40.0
    ground = np.stack(np.meshgrid(*[np.arange(a, b, 0.7) for a, b in zip(low, high, strict=True)]), axis=-1).reshape(
        -1, 2
    )
    parts = [np.column_stack([ground, np.zeros(len(ground))])]
    placed = 0
    while placed < len(path) // 4:
        centre, large = rng.uniform(low, high), rng.random() < 0.5
        size = rng.uniform(4.0, 10.0, 2) if large else rng.uniform(0.3, 1.5, 2)
        if np.linalg.norm(path - centre, axis=1).min() < 5.0 + np.linalg.norm(size) / 2:
            continue
        placed += 1
        height = rng.uniform(3.0, 9.0) if large else rng.uniform(1.0, 5.0)
        around, up = np.arange(0.0, 2 * size.sum(), 0.35), np.arange(0.0, height, 0.35)
        side = np.digitize(around, np.cumsum([size[0], size[1], size[0]]))
        along = around - np.r_[0.0, np.cumsum([size[0], size[1], size[0]])][side]
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
        towards = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
        turn = rng.uniform(0, np.pi)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        outline = centre + (corners[side] + along[:, None] * towards[side]) @ R.T
        parts.append(np.column_stack([np.repeat(outline, len(up), axis=0), np.tile(up, len(outline))]))
    return np.concatenate(parts)


def _path(corners: Sequence[tuple[float, float]]) -> np.ndarray:
    """Lidar poses ``(N, 4, 4)`` every metre along a path with rounded corners."""
    points = np.array(corners, dtype=np.float64)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    even = np.arange(0.0, s[-1], 0.25)
    smooth = gaussian_filter1d(np.column_stack([np.interp(even, s, c) for c in points.T]), 12.0, axis=0, mode="nearest")
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1)))
    even = np.arange(0.0, s[-1], 1.0)
    xy = np.column_stack([np.interp(even, s, c) for c in smooth.T])
    heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    rotations = se3.so3_exp(np.column_stack([np.zeros((len(xy), 2)), heading]))
    return se3.make(rotations, np.column_stack([xy, np.full(len(xy), 1.8)]))


def make_loop_drive(
    seed: int, corners: Sequence[tuple[float, float]], drift: float = 1.0, clouds: bool = True
) -> LoopDrive:
    """A drive along a path of ``corners``; ``drift`` scales odometry's noise of 1 cm and 0.05° per metre."""
    rng = np.random.default_rng(seed)
    poses = _path(corners)
    town = _town(rng, poses[:, :2, 3]) if clouds else None
    stamps = 10**18 + np.arange(len(poses)) * 10**8
    maker = LoopKeyframeSelector(LoopKeyframeSettings(spacing_m=3.5))
    for k, pose in enumerate(poses):
        if town is not None and k % 4 == 0:
            near = town[np.linalg.norm(town[:, :2] - pose[:2, 3], axis=1) < 45.0]
            near = near[rng.random(len(near)) < 0.5]
            points = se3.transform(se3.inverse(pose), near) + rng.normal(0.0, 0.02, (len(near), 3))
            maker.offer(k, Scan(int(stamps[k]), points.astype(np.float32)), pose)
    truth = Trajectory(stamps, se3.between(poses[0], poses))
    sigmas = drift * np.array([1e-4, 1e-4, 9e-4, 0.01, 0.01, 0.003])
    steps = se3.between(poses[:-1], poses[1:]) @ se3.exp(sigmas * rng.standard_normal((len(poses) - 1, 6)))
    relative = tuple(RelativePose(step, np.diag(sigmas**2), "test") for step in steps)
    online, covariances = [np.eye(4)], [1e-12 * np.eye(6)]
    for step in relative:
        online.append(online[-1] @ step.pose)
        covariances.append(se3.compose_covariance(covariances[-1], step.pose, step.covariance))
    nothing = ImuSamples.empty()
    record = Record(
        Trajectory(stamps, np.array(online), np.array(covariances)), relative, relative, nothing, (),
        start_state(int(stamps[0]), nothing, ImuNoise()), Calibration(), ImuNoise(), keyframes=maker.keyframes(),
    )  # fmt: skip
    return LoopDrive(record, truth)


@pytest.fixture(scope="session")
def loop_drive() -> Callable[..., LoopDrive]:
    """Return :func:`make_loop_drive`, which makes drives with loops."""
    return make_loop_drive


@pytest.fixture(scope="session")
def round_trip() -> LoopDrive:
    """Around a block, again along its first street, and back in the other lane: 20 revisits in each direction."""
    there = [(0, 0), (90, 0), (90, 60), (0, 60), (0, 0), (75, 0), (75, 3.5), (0, 3.5)]
    return make_loop_drive(3, there, drift=2.0)


@pytest.fixture(scope="session")
def closed_round_trip(round_trip: LoopDrive) -> LoopSearch:
    """The loops of ``round_trip``."""
    return find_loops(round_trip.record)
