"""Pose files to drive along."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.drive.pose_files import path_along, read_lidar_poses
from hybridlio.simulation.plan import plan
from hybridlio.simulation.rig import T_CAMERA_LIDAR, T_IMU_LIDAR


def curve(count: int = 120) -> np.ndarray:
    """Lidar poses along a gentle curve at 8 m/s, every 0.1 s."""
    t = np.arange(count) / 10
    attitude = Rotation.from_euler("z", 0.1 * t[:, None]).as_matrix()
    return se3.make(attitude, 80 * np.column_stack([np.sin(0.1 * t), 1 - np.cos(0.1 * t), 0 * t]))


def write_kitti(path: Path, poses: np.ndarray) -> Path:
    np.savetxt(path, poses[:, :3].reshape(-1, 12))
    return path


def test_camera_poses_are_read_as_lidar_poses(tmp_path: Path):
    lidar = curve()
    camera = T_CAMERA_LIDAR @ lidar @ se3.inverse(T_CAMERA_LIDAR)  # in the first camera's frame, as KITTI has it
    read = read_lidar_poses(write_kitti(tmp_path / "poses.txt", camera), "camera")
    np.testing.assert_allclose(se3.between(read[0], read), lidar, atol=1e-9)
    np.testing.assert_allclose(read[:, :3, 2].mean(axis=0), [0, 0, 1], atol=1e-6)


def test_a_tum_file_is_interpolated_at_ten_scans_per_second(tmp_path: Path):
    lidar = curve()
    fine = path_along(lidar)
    times = np.arange(0.0, 10.0, 0.04)
    poses = fine.poses(times) @ T_IMU_LIDAR
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(tmp_path / "tum.txt", np.column_stack([1e9 + times, poses[:, :3, 3], quaternion]))
    read = read_lidar_poses(tmp_path / "tum.txt", "camera")
    truth = fine.poses(np.arange(len(read)) / 10) @ T_IMU_LIDAR
    np.testing.assert_allclose(se3.between(read[0], read), se3.between(truth[0], truth), atol=5e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n" * 20, "row 1 has 3 columns; expected one of TUM"),
        ("a b\n", "row 1 has 2 columns"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 9, "9 poses; a drive needs at least 10"),
        ("".join(f"{k} 0 0 0 0 0 0 0\n" for k in range(20)), "row 1: the length of the quaternion"),
    ],
)
def test_other_files_are_rejected(tmp_path: Path, text: str, message: str):
    (tmp_path / "x.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        read_lidar_poses(tmp_path / "x.txt", "camera")


def test_the_drive_passes_the_poses_of_the_file_at_their_times(tmp_path: Path):
    file = write_kitti(tmp_path / "poses.txt", curve())
    drive = plan(SimulationConfig(poses=file, poses_frame="lidar", traffic_per_km=0.0))
    driven = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    assert len(driven) == 120
    np.testing.assert_allclose(se3.between(driven[0], driven), curve(), atol=2e-3)


def test_poses_of_a_standing_car_give_a_standing_drive(tmp_path: Path):
    file = write_kitti(tmp_path / "poses.txt", np.tile(np.eye(4), (30, 1, 1)))
    drive = plan(SimulationConfig(poses=file, poses_frame="lidar"))
    np.testing.assert_allclose(drive.path.motion(drive.scan_times_s).velocity_m_s, 0.0, atol=1e-9)


def test_a_recorded_path_is_followed_within_centimetres(kitti_odometry_root: Path):
    file = kitti_odometry_root / "poses" / "03.txt"  # comes back to nowhere, so its heights stay
    drive = plan(SimulationConfig(poses=file, traffic_per_km=0.0))
    truth = read_lidar_poses(file, "camera")
    driven = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    off = np.linalg.norm(driven[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert len(driven) == len(truth)
    assert np.median(off) < 0.01
    assert off.max() < 0.05
    assert np.abs(drive.path.motion(drive.scan_times_s).acceleration_m_s2).max() < 5.0


def test_a_recorded_path_with_loops_keeps_its_horizontal_positions(kitti_odometry_root: Path):
    file = kitti_odometry_root / "poses" / "00.txt"
    drive = plan(SimulationConfig(poses=file, traffic_per_km=0.0))
    lidar = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    truth = read_lidar_poses(file, "camera")
    beside = np.linalg.norm(lidar[:, :2, 3] - truth[:, :2, 3], axis=1)
    assert np.percentile(beside, 99) < 0.05
