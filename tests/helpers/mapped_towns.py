"""Drives through simulated towns, with the noise of an odometry: one makes a map, others come back to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.localization.localizer import MapPose
from hybridlio.localization.prior_map import PriorMap
from hybridlio.record.loop_keyframes import LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.record.record import Record
from hybridlio.simulation import SimulationConfig
from hybridlio.simulation.measurements import scan_at
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.rig import T_IMU_LIDAR
from hybridlio.simulation.sensors.lidar import ray_pattern

UP = np.array([0.0, 0.0, 1.0])
SIGMAS = np.array([5e-5, 5e-5, 1e-4, 2e-3, 2e-3, 1e-3])  # of a step of a metre; odometry on these drives has less
START_NS = 10**18


@dataclass(frozen=True, eq=False)
class TownDrive:
    """A drive with the steps of an odometry.

    Attributes:
        truth: ``(N, 4, 4)`` ``T_town_lidar``; the town's frame is that of every drive through it.
        steps: ``N-1`` steps with noise that their covariances state.
        poses: ``(N, 4, 4)`` that the steps add up to, in the first scan's frame.
    """

    config: SimulationConfig
    plan: Drive
    first: int  # the scan of the plan at which it begins
    truth: np.ndarray
    steps: tuple[RelativePose, ...]
    poses: np.ndarray

    @property
    def up(self) -> np.ndarray:
        """Up ``(3,)`` in the first scan's frame."""
        return np.asarray(self.truth[0, :3, :3].T @ UP)

    @property
    def stamps_ns(self) -> np.ndarray:
        return np.asarray(START_NS + np.arange(len(self.truth)) * 10**8)

    def scans(self, first: int = 0, every: int = 1) -> Iterator[tuple[int, Scan]]:
        """Yield rows and scans."""
        pattern = ray_pattern(self.config.lidar_model)
        for k in range(first, len(self.truth), every):
            scan = scan_at(self.plan, self.first + k, pattern, self.config)
            yield k, Scan(int(self.stamps_ns[k]), scan.points)

    def part(self, first: int, last: int | None = None) -> TownDrive:
        """Return the drive of some of the scans."""
        rows = slice(first, last)
        truth = self.truth[rows]
        poses = se3.between(self.poses[first], self.poses[rows])
        return TownDrive(self.config, self.plan, self.first + first, truth, self.steps[first:][: len(truth) - 1], poses)

    def record(self, max_range_m: float = 80.0) -> Record:
        """Return the run with its keyframes."""
        selector = LoopKeyframeSelector(LoopKeyframeSettings(max_range_m=max_range_m))
        for k, scan in self.scans(every=4):
            selector.offer(k, scan, self.poses[k])
        covariances = [1e-12 * np.eye(6)]
        for step in self.steps:
            covariances.append(se3.compose_covariance(covariances[-1], step.pose, step.covariance))
        nothing = ImuSamples.empty()
        online = Trajectory(self.stamps_ns, self.poses, np.array(covariances))
        start = start_state(START_NS, nothing, ImuNoise())
        return Record(
            online, self.steps, self.steps, nothing, (), start, Calibration(), ImuNoise(), selector.keyframes()
        )


@dataclass(frozen=True, eq=False)
class MappedTown:
    """The drive that made the map, its record, and the map."""

    drive: TownDrive
    record: Record
    prior: PriorMap

    def true_pose(self, T_town_lidar: np.ndarray) -> np.ndarray:
        """Pose of a lidar in the map: relative to the nearest pose of the drive that made it."""
        near = np.linalg.norm(self.drive.truth[:, :3, 3] - T_town_lidar[:3, 3], axis=1).argmin()
        return np.asarray(self.drive.poses[near] @ se3.between(self.drive.truth[near], T_town_lidar))

    def errors(self, drive: TownDrive, poses: dict[int, MapPose]) -> np.ndarray:
        """Errors ``(N, 6)`` of poses by row."""
        return np.array([se3.log(se3.between(one.at.pose, self.true_pose(drive.truth[k]))) for k, one in poses.items()])


def town_drive(seed: int, drive_seed: int | None = None, length_m: float = 120.0, lidar: str = "16-beam") -> TownDrive:
    """Return a drive of some length at 10 scans per second and about 10 m/s."""
    config = SimulationConfig(seed=seed, drive_seed=drive_seed, length_m=length_m, lidar=lidar)
    drive = plan(config)
    truth = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    true_steps = se3.between(truth[:-1], truth[1:])
    noise = np.random.default_rng(config.own_seed).standard_normal((len(true_steps), 6)) * SIGMAS
    steps = tuple(RelativePose(T, np.diag(SIGMAS**2), "test") for T in true_steps @ se3.exp(noise))
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step.pose)
    return TownDrive(config, drive, 0, truth, steps, se3.orthonormalise(np.array(poses)))
