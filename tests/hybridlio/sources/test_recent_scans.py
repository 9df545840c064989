"""Relative poses to several recent scans: on a drive, over lost scans, and with wrong answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, Scan
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import RESIDUAL_SOURCES
from hybridlio.odometry.setup import Setup
from hybridlio.record.record import Record
from hybridlio.sources.recent_scans import WithRecentScans
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.settings import RecentScansSettings, ScanMatchingSettings

COVARIANCE = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2)
STEP = se3.exp(np.array([0.0, 0.0, 0.01, 1.0, 0.0, 0.0]))


class Numbered:
    """A source whose scans are numbers. It finds each scan one step after the one before, unless set otherwise."""

    name = "numbered"

    def __init__(self) -> None:
        self.current_scan: int = 0
        self.failed: set[int] = set()
        self.wrong: set[tuple[int, int]] = set()
        self.taken_back: list[int] = []

    def start(self, frame: Frame) -> None:
        self.current_scan = frame.index

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        self.current_scan = frame.index
        return replace(initial, ok=False) if frame.index in self.failed else RelativePose(STEP, COVARIANCE, self.name)

    def pair(self, earlier: int, current: int, initial: RelativePose) -> RelativePose:
        if current in self.failed:
            return replace(initial, ok=False)
        slip = se3.exp(np.array([0, 0, 0, 1.0, 0, 0])) if (earlier, current) in self.wrong else np.eye(4)
        return RelativePose(np.linalg.matrix_power(STEP, current - earlier) @ slip, COVARIANCE, self.name)

    def take_back(self, initial: RelativePose) -> None:  # noqa: ARG002
        self.taken_back.append(self.current_scan)


def frame(k: int) -> Frame:
    return Frame(k, Scan(1000 + k, np.empty((0, 3), np.float32)))


GUESS = RelativePose(STEP @ se3.exp(np.array([0, 0, 0, 0.3, 0, 0])), 100 * COVARIANCE, "guess")


def numbered(**settings: Any) -> tuple[Numbered, WithRecentScans]:
    source = Numbered()
    keyed = WithRecentScans(source, RecentScansSettings(**{"count": 2, "distance_m": 1.5, **settings}))
    keyed.start(frame(0))
    return source, keyed


def behind(step: RelativePose) -> list[int]:
    return sorted(keyframe.stamp_ns - 1000 for keyframe in step.earlier_scans)


def test_each_scan_is_compared_with_recent_scans_other_than_the_last():
    _, keyed = numbered()
    steps = [keyed.refine(frame(k), GUESS) for k in range(1, 8)]
    # with a recent scan every other metre and steps of one metre
    assert [behind(step) for step in steps] == [[], [0], [0], [0, 2], [2], [2, 4], [4]]
    for k, step in enumerate(steps, 1):
        for near in step.earlier_scans:
            np.testing.assert_allclose(near.pose, np.linalg.matrix_power(STEP, k - near.stamp_ns + 1000), atol=1e-12)


def test_shared_noise_is_split_from_each_poses_own():
    _, keyed = numbered(shared=0.6)
    for k in range(1, 4):
        step = keyed.refine(frame(k), GUESS)
    assert step.drift is not None
    np.testing.assert_allclose(step.covariance, COVARIANCE)
    np.testing.assert_allclose(step.drift, 0.4 * COVARIANCE)
    np.testing.assert_allclose(step.earlier_scans[0].covariance, 0.4 * COVARIANCE)


def test_after_a_failed_scan_the_last_good_one_is_compared():
    source, keyed = numbered(distance_m=50.0, count=1)
    source.failed = {3}
    steps = [keyed.refine(frame(k), GUESS) for k in range(1, 6)]
    assert [step.ok for step in steps] == [True, True, False, True, True]
    assert [behind(step) for step in steps] == [[], [0], [], [0, 2], [0]]
    assert steps[2].drift is None


def test_a_pose_that_contradicts_the_path_is_left_out():
    source, keyed = numbered()
    source.wrong = {(2, 4)}
    steps = [keyed.refine(frame(k), GUESS) for k in range(1, 6)]
    assert [behind(step) for step in steps] == [[], [0], [0], [0], [2]]


def test_a_scan_taken_back_is_forgotten_and_the_path_continues_by_the_initial_pose():
    source, keyed = numbered()
    for k in (1, 2):
        keyed.refine(frame(k), GUESS)
    keyed.take_back(RelativePose(STEP, COVARIANCE, "imu"))
    assert source.taken_back == [2]
    assert behind(keyed.refine(frame(3), GUESS)) == [0, 1]


@pytest.mark.parametrize("wrong", [{"count": -1}, {"distance_m": 0.0}, {"angle_deg": float("nan")}, {"shared": 1.0}])
def test_settings_out_of_range_are_refused(wrong: dict[str, float]):
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))}: must be"):
        RecentScansSettings(**wrong)


# ------------------------------------------------------------------------------------------------------ a hall

HALL = np.array([14.0, 9.0, 4.0])  # half the side lengths


def hall_scan(T_hall_lidar: np.ndarray, stamp_ns: int, rng: np.random.Generator) -> Scan:
    """Return where 4,000 random rays hit the hall's walls, with 2 cm of noise."""
    rays = rng.normal(size=(4000, 3)) * [1.0, 1.0, 0.4]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned, origin = rays @ T_hall_lidar[:3, :3].T, T_hall_lidar[:3, 3]
    with np.errstate(divide="ignore"):
        reach = ((np.sign(turned) * HALL - origin) / turned).min(axis=1) + 0.02 * rng.standard_normal(4000)
    return Scan(stamp_ns, (rays * reach[:, None]).astype(np.float32))


def hall_drive(seed: int, blind: tuple[int, ...] = ()) -> tuple[list[Frame], np.ndarray]:
    """Return frames without IMU, some without points, and the true poses in the first one's frame."""
    rng = np.random.default_rng(seed)
    step = se3.exp(np.array([0.0, 0.0, 0.01, 0.5, 0.0, 0.0]))
    poses = [se3.make(np.eye(3), [-8.0, -3.0, -1.0])]
    for _ in range(24):
        poses.append(poses[-1] @ step)
    scans = [hall_scan(T, 10**17 + k * 10**8, rng) for k, T in enumerate(poses)]
    nothing = np.empty((0, 3), np.float32)
    scans = [Scan(scan.stamp_ns, nothing) if k in blind else scan for k, scan in enumerate(scans)]
    return [Frame(k, scan) for k, scan in enumerate(scans)], se3.between(poses[0], np.array(poses))


def config(count: int, **changes: Any) -> Config:
    scan_matching = ScanMatchingSettings(target="last-scan")
    recent = RecentScansSettings(count=count, distance_m=1.5)
    return Config(initial_pose="constant-velocity", scan_matching=scan_matching, recent_scans=recent, **changes)


def driven(count: int, seed: int, blind: tuple[int, ...] = ()) -> tuple[np.ndarray, Record]:
    """Return the squared errors of the last ten poses (m²), and the record."""
    frames, true = hall_drive(seed, blind)
    odometry = Odometry(config=config(count))
    poses = np.array([odometry.step(frame).pose for frame in frames])
    return ((poses[-10:, :3, 3] - true[-10:, :3, 3]) ** 2).sum(axis=1), odometry.record()


def test_recent_scans_reduce_the_error():
    chained, keyed = (np.mean([driven(count, seed)[0] for seed in (1, 2)]) for count in (0, 3))
    assert keyed < 0.5 * chained


def test_recent_scans_bridge_a_blind_scan():
    off, record = driven(2, seed=4, blind=(12, 13))
    assert [k + 1 for k, step in enumerate(record.relative) if not step.ok] == [12, 13]
    assert np.sqrt(off.mean()) < 0.05


def test_poses_to_recent_scans_are_in_the_record(tmp_path: Path):
    _, record = driven(3, seed=1)
    record.save(tmp_path / "odometry.npz")
    loaded = Record.load(tmp_path / "odometry.npz")
    assert sum(len(step.earlier_scans) for step in loaded.relative) > 30
    assert {j - i for i, j, _ in loaded.edges} > {1, 2, 5}


def test_recent_scans_are_used_with_every_source_that_compares_pairs():
    setup = Setup(config(2), Calibration(), ImuNoise())
    assert isinstance(RESIDUAL_SOURCES["scan-matching"](setup), WithRecentScans)
    assert isinstance(RESIDUAL_SOURCES["network"](setup), WithRecentScans)
    local_map = replace(setup, config=Config(recent_scans=RecentScansSettings(count=2)))
    assert isinstance(RESIDUAL_SOURCES["scan-matching"](local_map), ScanMatching)
