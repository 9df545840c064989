"""Poses relative to several earlier scans: their factors, and that their shared noise counts once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import EarlierScanPose, RelativePose
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.evaluation.consistency import anees
from hybridlio.graph.base import isam as solver
from hybridlio.graph.run import factors
from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import IncrementalBackend
from hybridlio.graph.run.scan_numbers import ScanNumbers
from hybridlio.graph.run.smooth import smooth

BACK = (2, 4, 8)
SHARED = 0.75  # of each relative pose's covariance is noise of the two scans


def drive_through(backend: IncrementalBackend, drive: Any) -> np.ndarray:
    """Lidar poses at all scans but the first, and their covariances in the backend's states."""
    backend.start(drive.start)
    return np.array([backend.update(f, r) for f, r in zip(drive.frames[1:], drive.relative, strict=True)])


def without_imu(drive: Any) -> Any:
    frames = [replace(frame, imu=ImuSamples.empty()) for frame in drive.frames]
    start = start_state(frames[0].scan.stamp_ns, ImuSamples.empty(), drive.noise)
    return replace(drive, frames=frames, start=start)


def errors(states: np.ndarray, drive: Any) -> np.ndarray:
    poses = np.array([state.T_world_imu for state in states])
    return np.asarray(se3.log(se3.between(poses, drive.poses[1:])))


# ------------------------------------------------------------------------------------------------ which factors


def scans(count: int, on_map_path: bool) -> ScanNumbers:
    out = ScanNumbers(1000)
    for k in range(1, count):
        out.add(1000 + k, on_map_path)
    return out


def joined(relative: RelativePose, of: ScanNumbers) -> list[list[str]]:
    graph = factors.earlier_scan_factors(5, relative, of, np.eye(4))
    return [[gtsam.DefaultKeyFormatter(key) for key in factor.keys()] for factor in graph]  # noqa: SIM118


def step(*back_stamps: int, **changes: Any) -> RelativePose:
    earlier = tuple(EarlierScanPose(stamp, np.eye(4), np.eye(6)) for stamp in back_stamps)
    return replace(RelativePose(np.eye(4), np.eye(6), "test", earlier_scans=earlier), **changes)


def test_independent_poses_join_the_scans_poses():
    assert joined(step(1002, 1000), scans(5, on_map_path=False)) == [["x2", "x5"], ["x0", "x5"]]


def test_poses_that_share_scatter_join_poses_on_the_map_path():
    shared = step(1002, 1000, drift=0.25 * np.eye(6))
    assert joined(shared, scans(5, on_map_path=True)) == [["m2", "m5"], ["m0", "m5"]]
    assert joined(shared, scans(5, on_map_path=False)) == [["x2", "m5"], ["x0", "m5"]]


def test_a_failed_step_keeps_its_poses_relative_to_earlier_scans():
    assert joined(step(1002, ok=False), scans(5, on_map_path=True)) == [["x2", "x5"]]
    assert joined(step(1002, ok=False, drift=0.25 * np.eye(6)), scans(5, on_map_path=True)) == [["x2", "x5"]]


def test_removed_scans_are_skipped_and_unknown_ones_are_an_error():
    some = scans(5, on_map_path=True)
    some.remove(range(2))
    assert joined(step(1001, 1003), some) == [["x3", "x5"]]
    with pytest.raises(DataError, match="scan at 1077 ns, but no scan has this stamp"):
        joined(step(1077), some)


# -------------------------------------------------------------------------------------------------- correlation


@pytest.fixture(scope="module")
def drives(chain: Callable[..., Any]) -> list[Any]:
    """Drives whose relative poses share their scans' noise; without IMU, so that nothing else has an influence."""
    share = 1 - SHARED
    return [without_imu(chain(seed, steps=40, drift_share=share, back=BACK)) for seed in range(300, 312)]


def last_scan_only(drive: Any) -> Any:
    """The drive with poses relative to the last scan only."""
    return replace(drive, relative=[replace(relative, earlier_scans=()) for relative in drive.relative])


def claiming(drive: Any, share: float | None) -> Any:
    """Return the drive with another stated share of scan noise in the covariance; None states independent errors."""

    def claim(relative: RelativePose) -> RelativePose:
        own = relative.covariance * (1.0 if share is None else 1 - share)
        earlier = tuple(replace(k, covariance=own) for k in relative.earlier_scans)
        return replace(relative, drift=None if share is None else own, earlier_scans=earlier)

    return replace(drive, relative=[claim(relative) for relative in drive.relative])


def judged(drives: list[Any]) -> tuple[float, float, float]:
    """ANEES of poses and of steps, and the root mean square position error in metres."""
    poses, steps, metres = [], [], []
    for drive in drives:
        backend = IncrementalBackend(InertialSteps(drive.calibration, drive.noise))
        backend.start(drive.start)
        for k, (frame, relative) in enumerate(zip(drive.frames[1:], drive.relative, strict=True), 1):
            state = backend.update(frame, relative)
            off = se3.log(se3.between(state.T_world_imu, drive.poses[k]))
            poses.append((off, state.covariance[:6, :6]))
            metres.append(off[3:] @ off[3:])
            last = backend.last_step()
            true = se3.between(drive.lidar_poses[k - 1], drive.lidar_poses[k])
            steps.append((se3.log(se3.between(last.pose, true)), last.covariance))
    values = [anees(*(np.array(part) for part in zip(*pairs, strict=True))).value for pairs in (poses, steps)]
    return values[0], values[1], float(np.sqrt(np.mean(metres)))


def test_several_factors_per_scan_are_consistent_and_more_accurate_than_one(drives: list[Any]):
    poses, steps, metres = judged(drives)
    assert 0.8 < poses < 1.25
    assert 0.8 < steps < 1.25
    assert metres < 0.8 * judged([last_scan_only(drive) for drive in drives])[2]


def test_taken_as_independent_they_would_be_overconfident(drives: list[Any]):
    assert judged([claiming(drive, None) for drive in drives])[1] > 1.8


def test_claiming_more_shared_noise_than_true_is_conservative(chain: Callable[..., Any]):
    drives = [without_imu(chain(seed, steps=40, drift_share=0.6, back=BACK)) for seed in range(320, 328)]
    poses, steps, _ = judged([claiming(drive, SHARED) for drive in drives])
    assert poses < 1.25
    assert steps < 1.25


def test_smoothing_with_several_factors_per_scan_is_consistent(chain: Callable[..., Any]):
    found, claimed = [], []
    for seed in range(340, 352):
        drive = chain(seed, steps=30, drift_share=1 - SHARED, back=BACK)
        online = np.concatenate([np.eye(4)[None], drive.lidar_poses[1:]])
        smoothed = smooth(drive.record(online)).trajectory
        assert smoothed.covariances is not None
        found += list(se3.log(se3.between(smoothed.poses, drive.lidar_poses))[1:])
        claimed += list(smoothed.covariances[1:])
    assert 0.75 < anees(np.array(found), np.array(claimed)).value < 1.25


# ----------------------------------------------------------------------------------------------- constant memory


@pytest.mark.parametrize("back", [(), BACK], ids=["last scan", "earlier scans"])
def test_marginalising_old_scans_works_when_they_are_relinearised(
    chain: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, back: tuple[int, ...]
):
    """iSAM2 crashes if it marginalises variables that it did not eliminate first."""
    low = {kind: 1e-4 * change for kind, change in solver._RELINEARISATION_THRESHOLDS.items()}
    monkeypatch.setattr(solver, "_RELINEARISATION_THRESHOLDS", low)
    drive = chain(seed=9, steps=110, drift_share=1 - SHARED, back=back)
    lagged = FixedLagBackend(InertialSteps(drive.calibration, drive.noise), lag_scans=30)
    states = drive_through(lagged, drive)
    whole = drive_through(IncrementalBackend(InertialSteps(drive.calibration, drive.noise)), drive)
    assert lagged._isam.getLinearizationPoint().size() <= 5 * 51
    sigmas = np.sqrt(np.diag(whole[-1].covariance)[:6])
    assert (np.abs(errors(states[-1:], drive) - errors(whole[-1:], drive)) < 0.1 * sigmas).all()
