"""Faults injected into a recording."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import ImuNoise, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.faults import block_sector, drop_scans, imu_bias, imu_gap

STAMPS = 1_700_000_000_000_000_000 + np.arange(101) * 100_000_000


def load(k: int) -> Scan:
    """Return a ring of 360 points, one per degree, with their numbers as intensity."""
    angles = np.radians(np.arange(360) - 179.5)
    points = np.column_stack([np.cos(angles), np.sin(angles), np.full(360, float(k))]).astype(np.float32)
    return Scan(int(STAMPS[k]), points, np.arange(360, dtype=np.float32), np.arange(360, dtype=np.int64))


@pytest.fixture
def sequence() -> Sequence:
    stamps = STAMPS[0] + np.arange(1001) * 10_000_000
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = np.arange(101)
    imu = ImuSamples(stamps, np.zeros((1001, 3)), np.tile([0.0, 0.0, 9.81], (1001, 1)))
    reference = Trajectory(STAMPS, poses)
    return Sequence("ring", STAMPS, load, imu, reference=reference, forward_speed_m_s=np.arange(101.0))


def test_dropping_scans_keeps_the_data_of_the_others(sequence: Sequence):
    dropped = drop_scans(sequence, 0.2, seed=4)
    assert len(dropped) == 81
    assert dropped.stamps_ns[0] == STAMPS[0]
    assert dropped.reference is not None
    assert dropped.forward_speed_m_s is not None
    for k in (1, 40, 80):
        row = int(np.searchsorted(STAMPS, dropped.stamps_ns[k]))
        assert dropped[k].scan.stamp_ns == STAMPS[row]
        assert dropped[k].scan.points[0, 2] == row
        assert dropped.reference.poses[k, 0, 3] == row == dropped.forward_speed_m_s[k]
        assert dropped[k].imu.stamps_ns[[0, -1]].tolist() == dropped.stamps_ns[[k - 1, k]].tolist()
    assert "20 of 101 scans" in dropped.notes[-1]


def test_dropped_scans_depend_only_on_the_seed(sequence: Sequence):
    first, again, other = (drop_scans(sequence, 0.2, seed).stamps_ns.tolist() for seed in (1, 1, 2))
    assert first == again != other


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_an_invalid_share_is_rejected(sequence: Sequence, share: float):
    with pytest.raises(ConfigError, match="share"):
        drop_scans(sequence, share)


@pytest.mark.parametrize(("middle", "where"), [(0.0, [1, 0]), (90.0, [0, 1]), (180.0, [-1, 0])])
def test_a_blocked_sector_has_no_points_during_the_interval(sequence: Sequence, middle: float, where: list[int]):
    blocked = block_sector(sequence, 2.0, 5.0, middle)
    for k, points in ((19, 360), (20, 180), (49, 180), (50, 360)):
        scan = blocked[k].scan
        assert len(scan) == points
        assert scan.intensity is not None
        assert scan.time_offsets_ns is not None
        np.testing.assert_array_equal(scan.points, load(k).points[scan.time_offsets_ns])
        np.testing.assert_array_equal(scan.intensity, scan.time_offsets_ns)
        if points == 180:
            assert (scan.points[:, :2] @ where < 0).all()


def test_an_imu_gap_has_no_samples_and_none_are_interpolated(sequence: Sequence):
    silent = imu_gap(sequence, 2.0, 3.0)
    assert len(silent.imu) == len(sequence.imu) - 100
    assert len(silent[25].imu) == 0
    assert len(silent[20].imu) == 10
    assert len(silent[31].imu) == 11


def test_injected_biases_are_multiples_of_the_noise_model(sequence: Sequence):
    for noise, assumed in ((None, ImuNoise()), (ImuNoise(1, 1, 1, 1, 0.5, 2.0),) * 2):
        object.__setattr__(sequence, "imu_noise", noise)
        biased = imu_bias(sequence, 3.0, seed=2)
        gyro, accel = biased.imu.gyro_rad_s, biased.imu.accel_m_s2 - sequence.imu.accel_m_s2
        np.testing.assert_allclose(np.abs(gyro), 3 * assumed.gyro_bias_sigma_rad_s)
        np.testing.assert_allclose(np.abs(accel), 3 * assumed.accel_bias_sigma_m_s2)
        np.testing.assert_array_equal(np.ptp(gyro, axis=0), 0.0)


def test_an_interval_that_ends_before_it_starts_is_rejected(sequence: Sequence):
    for fault in (block_sector, imu_gap):
        with pytest.raises(ConfigError, match="ends before it starts"):
            fault(sequence, 3.0, 2.0)
