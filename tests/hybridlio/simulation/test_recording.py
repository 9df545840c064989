"""Round trip: the readers read all that the simulator writes."""

from __future__ import annotations

import numpy as np
import pytest

import hybridlio as hl
from hybridlio.simulation.plan import plan
from hybridlio.simulation.rig import T_IMU_LIDAR

CONFIG = {"seconds": 1.0, "seed": 3, "lidar": "16-beam", "gps": True, "gps_rate_hz": 5.0, "motion_distortion": True}


@pytest.fixture(scope="module")
def config() -> hl.SimulationConfig:
    return hl.SimulationConfig(**CONFIG, imu_noise=hl.ImuNoise(gyro_rad_s_sqrt_hz=2e-3))


@pytest.fixture(scope="module")
def sequence(config, tmp_path_factory) -> hl.Sequence:
    return hl.open_sequence(hl.simulate(tmp_path_factory.mktemp("drive"), config))


def test_the_recording_gives_lidar_imu_noise_and_extrinsics(sequence, config):
    assert sequence.lidar == config.lidar_model
    assert sequence.imu_noise == config.imu_noise
    assert np.allclose(sequence.calibration.T_imu_lidar, T_IMU_LIDAR, atol=1e-12)


def test_the_reference_equals_the_simulated_path_to_a_micrometre(sequence, config):
    drive = plan(config)
    exact = hl.Trajectory(sequence.stamps_ns, drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR).from_first()
    assert np.abs(sequence.reference.poses - exact.poses).max() < 1e-6


def test_inertial_data_runs_at_100_hz_and_covers_every_scan(sequence):
    assert np.unique(np.diff(sequence.imu.stamps_ns)).tolist() == [10_000_000]
    assert sequence.imu.stamps_ns[0] < sequence.stamps_ns[0]
    assert sequence.imu.stamps_ns[-1] > sequence.stamps_ns[-1]


def test_gps_fixes_and_point_times_are_read(sequence, config):
    assert len(sequence.gps) == 5
    assert np.allclose(sequence.gps[0].covariance_m2, config.gps_sigma_m**2 * np.eye(3))
    offsets = [frame.scan.time_offsets_ns for frame in sequence]
    assert all(np.abs(o).max() <= 50_000_000 and np.ptp(o) > 80_000_000 for o in offsets)


def test_a_simulated_recording_has_no_notes(sequence):
    assert sequence.notes == ()


def test_a_finished_drive_is_kept_and_other_settings_are_rejected(tmp_path):
    small = hl.SimulationConfig(seconds=0.3, lidar="16-beam")
    drive = hl.simulate(tmp_path, small)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert hl.simulate(tmp_path, small) == drive
    with pytest.raises(hl.HybridLioError, match=r"simulation\.json describes another drive"):
        hl.simulate(tmp_path, small.model_copy(update={"seconds": 0.5}))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
