"""Correction of recorded heights, so that every path has one ground below it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.drive.pose_files import read_lidar_poses
from hybridlio.simulation.drive.revisits import level_revisits
from hybridlio.simulation.drive.rises import without_false_rises
from hybridlio.simulation.plan import plan
from hybridlio.simulation.rig import LIDAR_HEIGHT_M, T_IMU_LIDAR


def along(xy: np.ndarray, height: np.ndarray, speed_m_s: float = 8.0) -> np.ndarray:
    """Lidar poses every 0.1 s along a curve ``(N, 2)`` with heights ``(N,)``, pointing along it, uphill too."""
    points = np.column_stack([xy, height])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, s[-1], 0.1 * speed_m_s)
    position = np.column_stack([np.interp(at, s, points[:, i]) for i in range(3)])
    ahead = np.gradient(position, axis=0)
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    pitch = -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    return se3.make(Rotation.from_euler("ZY", np.column_stack([yaw, pitch])).as_matrix(), position)


def figure_eight() -> np.ndarray:
    """Two rounds of a figure eight that rises by four metres per quarter."""
    angle = np.linspace(0, 4 * np.pi, 4000)
    xy = np.column_stack([90 * np.sin(angle), 70 * np.sin(2 * angle)])
    return along(xy, 4 * angle / np.pi)


def streets_side_by_side() -> np.ndarray:
    """Back and forth on parallel streets 12 m apart, while the height drifts by 6 m."""
    xy = np.concatenate([[[0.0 if k % 2 else 250.0, 12.0 * k], [250.0 if k % 2 else 0.0, 12.0 * k]] for k in range(5)])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    even = np.arange(0.0, s[-1], 0.5)
    points = np.column_stack([np.interp(even, s, xy[:, i]) for i in range(2)])
    return along(points, 6 * np.sin(even / 130))


def widening_spiral() -> np.ndarray:
    """Three rounds of a spiral, each 10 m wider and 5 m higher."""
    angle = np.linspace(0, 6 * np.pi, 6000)
    radius = 40 + 10 * angle / (2 * np.pi)
    return along(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), 5 * angle / (2 * np.pi))


def rise_on_the_spot() -> np.ndarray:
    """A level road whose recorded height rises by 8 m while the car hardly moves."""
    poses = figure_eight()
    poses[:, :3, :3] = Rotation.from_euler("z", np.arctan2(poses[:, 1, 0], poses[:, 0, 0])[:, None]).as_matrix()
    poses[:, 2, 3] = np.interp(np.arange(len(poses)), [30, 50], [0.0, 8.0])
    return poses


MADE_UP = [figure_eight, streets_side_by_side, widening_spiral, rise_on_the_spot]


def above_ground(file: Path, frame: str) -> np.ndarray:
    """Return the lidar's height above the ground at each scan."""
    config = SimulationConfig.model_validate({"poses": file, "poses_frame": frame, "traffic_per_km": 0.0})
    drive = plan(config)
    lidar = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    return np.asarray(lidar[:, 2, 3] - drive.world.ground.height(lidar[:, :2, 3]))


@pytest.mark.parametrize("path", MADE_UP)
def test_the_lidar_keeps_its_height_where_a_path_crosses_itself(path, tmp_path: Path):
    np.savetxt(tmp_path / "poses.txt", path()[:, :3].reshape(-1, 12))
    above = above_ground(tmp_path / "poses.txt", "lidar")
    assert np.abs(above - LIDAR_HEIGHT_M).max() < 0.3


@pytest.mark.parametrize("sequence", ["00", "01", "02", "05", "06", "07", "08"])
def test_the_lidar_keeps_its_height_along_recorded_paths(kitti_odometry_root: Path, sequence: str):
    above = above_ground(kitti_odometry_root / "poses" / f"{sequence}.txt", "camera")
    assert np.abs(above - LIDAR_HEIGHT_M).max() < 0.3


def test_only_paths_that_return_at_another_height_are_changed():
    open_road = along(np.column_stack([np.arange(300.0), 30 * np.sin(np.arange(300.0) / 60)]), np.arange(300.0) / 20)
    np.testing.assert_array_equal(level_revisits(open_road), open_road)
    angle = np.linspace(0, 4 * np.pi, 2000)
    spiral = along(60 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.3 * angle)
    levelled = level_revisits(spiral)
    np.testing.assert_array_equal(levelled[:, :2, 3], spiral[:, :2, 3])
    round_ = len(spiral) // 2
    gap = np.abs(levelled[round_ + 50 : -50, 2, 3] - levelled[50 : len(spiral) - round_ - 50, 2, 3])
    assert gap.max() < 0.2
    assert np.abs(spiral[round_:, 2, 3] - spiral[: len(spiral) - round_, 2, 3]).min() > 1.8


def test_neighbouring_streets_have_no_cliff_between_them():
    levelled = level_revisits(streets_side_by_side())
    middle = np.abs(levelled[:, 0, 3] - 125.0) < 0.5
    heights = levelled[middle, 2, 3]
    assert np.abs(np.diff(heights)).max() < 0.1 + 0.15 * 12.0 + 0.1


def test_a_rise_is_removed_only_if_the_pitch_contradicts_it():
    hill = along(np.column_stack([np.arange(300.0), np.zeros(300)]), 20 / (1 + np.exp(-(np.arange(300.0) - 150) / 20)))
    np.testing.assert_array_equal(without_false_rises(hill), hill)
    cliff = hill.copy()
    cliff[200:, 2, 3] += 5.0
    np.testing.assert_allclose(without_false_rises(cliff)[:, 2, 3], hill[:, 2, 3], atol=0.3)


def test_the_false_rise_of_kitti_08_is_removed_and_00_is_unchanged(kitti_odometry_root: Path):
    eighth, first = (read_lidar_poses(kitti_odometry_root / "poses" / f"{n}.txt", "camera") for n in ("08", "00"))
    assert np.ptp(eighth[:100, 2, 3]) > 10.0
    assert np.ptp(without_false_rises(eighth)[:100, 2, 3]) < 2.0
    np.testing.assert_array_equal(without_false_rises(first), first)
