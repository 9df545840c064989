"""Faults that occur in practice, on a short drive: the error stays bounded, or the covariance reports it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Frame, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.registration.motion_search import best_start
from hybridlio.runs.run import Run, run_odometry
from hybridlio.simulation.faults import block_sector, drop_scans, imu_bias, imu_gap
from hybridlio.simulation.scenarios import open_scenario
from hybridlio.sources import scan_matching
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.thinned_scan import ThinnedScan


def ran(sequence: Sequence, **names: str) -> Run:
    run = run_odometry(sequence, Odometry(config=Config(**names)))
    assert run.stopped is None
    assert len(run.estimates) == len(sequence)
    return run


def farthest_off_m(run: Run) -> float:
    """Return the largest horizontal error; 16 beams observe height badly even without faults."""
    assert run.sequence.reference is not None
    errors = se3.log(se3.between(run.trajectory.poses, run.sequence.reference.poses))
    return float(np.linalg.norm(errors[:, 3:5], axis=1).max())


@pytest.fixture(scope="module")
def normal_m(sequence: Sequence) -> float:
    return farthest_off_m(ran(sequence))


FAULTS: dict[str, Callable[[Sequence], Sequence]] = {
    "a fifth of the scans lost": partial(drop_scans, share=0.2, seed=1),
    "half of the view blocked for a second": partial(block_sector, start_s=0.8, end_s=1.8),
    "no inertial samples for a second": partial(imu_gap, start_s=0.8, end_s=1.8),
    "biases three times the assumed": partial(imu_bias, sigmas=3.0, seed=1),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_adds_little_error(fault: str, sequence: Sequence, normal_m: float):
    run = ran(FAULTS[fault](sequence))
    assert farthest_off_m(run) < 2 * normal_m + 0.03
    assert run.bridged == []


def test_without_scans_and_samples_the_covariance_grows_with_the_error(sequence: Sequence):
    dark = block_sector(imu_gap(sequence, 1.0, 1.5), 1.0, 1.5, width_deg=360.0)
    run = ran(dark)
    assert run.bridged == [10, 11, 12, 13, 14]
    spread = [float(np.sqrt(np.trace(e.covariance[3:, 3:]))) for e in run.estimates]
    assert spread[14] > 10 * spread[9]
    assert sequence.reference is not None
    off = np.linalg.norm(run.trajectory.poses[:, :3, 3] - sequence.reference.poses[:, :3, 3], axis=1)
    assert (off[10:15] < 4 * np.array(spread[10:15])).all()


def thinned(frame: Frame) -> ThinnedScan:
    source = ScanMatching()
    source.start(frame)
    assert source.current_scan is not None
    return source.current_scan


def test_corners_along_the_ground_between_smooth_walls_cause_no_roll(tmp_path: Path):
    """Such corners look the same in every scan: roll from them would add up and, by gravity, falsify the speed."""
    corridor = open_scenario("corridor", tmp_path, seed=1, length_m=16.0)
    assert corridor.reference is not None
    steps = se3.between(corridor.reference.poses[:-1], corridor.reference.poses[1:])
    scans, turns_rad = [thinned(frame) for frame in corridor], []
    for earlier, later, step in zip(scans[:-1], scans[1:], steps, strict=True):
        guess = RelativePose(step, 1e-6 * np.eye(6), "truth")
        turns_rad.append(se3.log(se3.between(step, ScanMatching().pair(earlier, later, guess).pose))[0])
    assert abs(np.mean(turns_rad)) < 5e-5


# ----------------------------------------------------------------------------------- initial poses that know little


def test_an_initial_pose_source_without_motion_costs_one_search_at_the_start(
    sequence: Sequence, monkeypatch: pytest.MonkeyPatch
):
    searches = []

    def counted(*given: Any) -> np.ndarray:
        searches.append(1)
        return best_start(*given)

    monkeypatch.setattr(scan_matching, "best_start", counted)
    run = ran(sequence.part(0, 10), initial_pose="identity")
    assert len(searches) == 1
    assert farthest_off_m(run) < 0.05


def test_the_motion_is_searched_again_after_a_rejected_scan(sequence: Sequence, monkeypatch: pytest.MonkeyPatch):
    searches = []
    monkeypatch.setattr(scan_matching, "best_start", lambda _, __, ___, starts, *____: searches.append(1) or starts[0])
    matching = ScanMatching()
    matching.start(sequence[0])
    unsure = RelativePose(np.eye(4), np.diag(np.r_[np.full(3, 0.1), np.full(3, 2.0)] ** 2), "guess")
    for k in (1, 2):
        matching.refine(sequence[k], unsure)
    matching.take_back(unsure)
    matching.refine(sequence[3], unsure)
    assert len(searches) == 2


def guess(pose: np.ndarray, sigma_rad: float = 0.01, sigma_m: float = 0.1) -> RelativePose:
    return RelativePose(pose, np.diag(np.r_[np.full(3, sigma_rad), np.full(3, sigma_m)] ** 2), "guess")


def test_scans_are_found_from_the_last_motion_when_the_imu_is_wrong(sequence: Sequence):
    """The gate rejects steps that contradict a wrong IMU. The next scans must still be found in the map."""
    assert sequence.reference is not None
    true, matching, whole = sequence.reference.poses, ScanMatching(), np.eye(4)
    matching.start(sequence[0])
    for k in range(1, 6):
        whole = whole @ matching.refine(sequence[k], guess(se3.between(true[k - 1], true[k]))).pose
    wrong = se3.exp(np.array([0.1, 0.2, 0.6, 1.0, 0.5, 0.0]))
    for k in range(6, 12):
        found = matching.refine(sequence[k], guess(wrong))
        assert found.ok
        off = se3.log(se3.between(whole @ found.pose, true[k]))
        assert np.linalg.norm(off[:3]) < np.deg2rad(0.3)
        assert np.linalg.norm(off[3:]) < 0.1
        matching.take_back(guess(wrong))
        whole = whole @ wrong


def test_a_search_fails_when_the_scan_matches_under_no_motion(sequence: Sequence):
    matching, frame = ScanMatching(), sequence[1]
    matching.start(sequence[0])
    far = Scan(frame.scan.stamp_ns, frame.scan.points / 30 + np.array([0.0, 0.0, 60.0], np.float32))
    assert not matching.refine(replace(frame, scan=far), guess(np.eye(4), 3.0, 30.0)).ok
