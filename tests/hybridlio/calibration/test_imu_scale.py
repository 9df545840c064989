"""Scale and misalignment of an IMU, found from the path of the scans."""

from __future__ import annotations

import handheld
import numpy as np
import pytest

from hybridlio.calibration.imu_scale import FoundScale, find_imu_scale
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory

SECONDS = 40.0
SCATTER = np.r_[np.full(3, 5e-4), np.full(3, 3e-3)]  # rad, m: of the poses of a registration against a map


def wrong_scale(seed: int) -> ImuScale:
    """Return what a consumer IMU makes of true values."""
    rng = np.random.default_rng(seed)
    across = 1 - np.eye(3)
    gyro, accel = (
        np.eye(3) + np.diag(rng.choice([-size, size], 3)) + across * rng.uniform(-0.01, 0.01, (3, 3))
        for size in (0.015, 0.005)
    )
    return ImuScale(gyro, accel)


def scattered(path: Trajectory, seed: int) -> Trajectory:
    errors = np.random.default_rng(seed).normal(0, SCATTER, (len(path), 6))
    return Trajectory(path.stamps_ns, path.poses @ se3.exp(errors))


@pytest.fixture(scope="module")
def walk() -> handheld.Handheld:
    return handheld.carried(np.random.default_rng(8), seconds=SECONDS)


def found_with(walk: handheld.Handheld, seed: int) -> tuple[FoundScale, Array, Array]:
    """Return what is found, and its errors of both matrices, row by row."""
    wrong = wrong_scale(seed)
    found = find_imu_scale(scattered(walk.path, seed), wrong.corrected(walk.imu), handheld.MOUNTING)
    assert found is not None
    gyro, accel = found.scale.gyro - np.linalg.inv(wrong.gyro), found.scale.accel - np.linalg.inv(wrong.accel)
    return found, gyro.ravel(), accel.ravel()


def test_a_walk_shows_the_scale_within_its_covariance(walk: handheld.Handheld):
    """Errors are a fifth of those before, and 0.5 to 2 times what the covariance states, over several IMUs."""
    nees, left = [], []
    for seed in range(4):
        found, gyro, accel = found_with(walk, seed)
        nees.append(
            [
                gyro @ np.linalg.solve(found.gyro_covariance, gyro),
                accel @ np.linalg.solve(found.accel_covariance, accel),
            ]
        )
        left.append([np.sqrt(np.mean(gyro**2)), np.sqrt(np.mean(accel**2))])
    assert np.mean(left, axis=0)[0] < 0.2 * 0.0105
    assert np.mean(left, axis=0)[1] < 0.005
    mean = np.mean(nees, axis=0) / 9
    assert 0.3 < mean[0] < 2
    assert 0.2 < mean[1] < 2


def test_corrected_samples_need_no_further_correction(walk: handheld.Handheld):
    found, _, _ = found_with(walk, 3)
    corrected = found.scale.corrected(wrong_scale(3).corrected(walk.imu))
    again = find_imu_scale(scattered(walk.path, 3), corrected, handheld.MOUNTING)
    assert again is not None
    assert np.abs(again.scale.gyro - np.eye(3)).max() < 0.5 * found.sigmas[0].max()


def test_failed_registrations_hardly_count(walk: handheld.Handheld):
    path = scattered(walk.path, 4)
    jumps = path.poses.copy()
    jumps[100:103] = jumps[100:103] @ se3.exp([0.2, 0.0, 0.1, 0.5, 0.0, 0.2])
    right = find_imu_scale(path, walk.imu, handheld.MOUNTING)
    wrong = find_imu_scale(Trajectory(path.stamps_ns, jumps), walk.imu, handheld.MOUNTING)
    assert right is not None
    assert wrong is not None
    assert np.abs(wrong.scale.gyro - right.scale.gyro).max() < 2 * right.sigmas[0].max()


def test_what_the_motion_does_not_show_stays_as_it_was():
    """A level turn about z alone shows the third column of the gyroscope's matrix, and nothing of the others."""
    times = np.arange(0, 40, 0.01)
    yaw = np.sin(0.5 * times)
    poses = se3.make(se3.so3_exp(np.outer(yaw, [0.0, 0.0, 1.0])), np.zeros((len(times), 3)))
    rates = np.outer(0.5 * np.cos(0.5 * times), [0.0, 0.0, 1.0])
    stamps = np.round(times * 1e9).astype(np.int64)
    imu = ImuSamples(stamps, rates @ wrong_scale(1).gyro.T, np.tile([0.0, 0.0, 9.807], (len(times), 1)))
    found = find_imu_scale(scattered(Trajectory(stamps[::10], poses[::10]), 1), imu, np.eye(4))
    assert found is not None
    shares = found.sigmas[0] / found.gyro_prior_sigmas.reshape(3, 3)
    assert (shares[:, :2] > 0.9).all()
    assert (shares[:, 2] < 0.3).all()


def test_a_short_path_shows_nothing(walk: handheld.Handheld):
    short = Trajectory(walk.path.stamps_ns[:100], walk.path.poses[:100])
    assert find_imu_scale(short, walk.imu, handheld.MOUNTING) is None
    assert find_imu_scale(walk.path, ImuSamples.empty(), handheld.MOUNTING) is None
