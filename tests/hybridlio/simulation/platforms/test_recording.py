"""Recordings of platforms: the IMU fits the path, points lie on surfaces, and nothing is run into."""

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from integration import integrate
from scipy.spatial.transform import Rotation

from hybridlio.core.sensors import NS_PER_S, ImuNoise
from hybridlio.simulation.platforms import recording as recordings
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.recording import PlatformRecording, plan
from hybridlio.simulation.platforms.scenes.table import SCENES
from hybridlio.simulation.sensors.imu import ideal_imu

CASES = [*((name, scene.platform) for name, scene in SCENES.items()), ("campus", "drone")]


def distances(recording: PlatformRecording, points: np.ndarray) -> np.ndarray:
    """Return the distance of points ``(N, 3)``, world frame, from the scene's surfaces."""
    relative = (points - recording.rays.origin).astype(np.float32)
    return recording.rays.scene.compute_distance(o3d.core.Tensor.from_numpy(relative)).numpy()


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def recording(request) -> PlatformRecording:
    scene, platform = request.param
    return plan(PlatformConfig(scene=scene, platform=platform, lidar="vlp-16", seconds=12.0, seed=3))


def test_integrating_the_ideal_imu_reproduces_the_path(recording: PlatformRecording):
    times = 1.0 + np.arange(2001) / 200
    motion = recording.path.motion(times)
    truth = Rotation.from_matrix(motion.poses[:, :3, :3])
    start = (truth[0], motion.poses[0, :3, 3], motion.velocity_m_s[0])
    attitude, position = integrate(times, *ideal_imu(recording.path, times), *start)
    assert np.linalg.norm(position - motion.poses[:, :3, 3], axis=1).max() < 2e-3
    assert np.degrees((attitude.inv() * truth).magnitude()).max() < 2e-2


def test_the_way_is_clear(recording: PlatformRecording):
    poses = recording.lidar_poses(np.arange(0.0, 12.0, 0.05))
    assert distances(recording, poses[:, :3, 3]).min() > 0.2


def test_the_body_moves_as_such_bodies_do(recording: PlatformRecording):
    motion = recording.path.motion(np.arange(0.0, 12.0, 0.01))
    rate_deg_s = np.degrees(np.linalg.norm(motion.angular_velocity_rad_s, axis=1))
    speed = np.linalg.norm(motion.velocity_m_s, axis=1)
    if recording.config.platform == "handheld":
        assert 0.4 < np.median(speed) < 1.6
        assert 60 < rate_deg_s.max() < 250
    if recording.config.platform in ("robot", "car"):
        assert rate_deg_s.max() < 90
        assert 0.5 < np.median(speed) < 10
    if recording.config.platform == "drone":
        assert 250 < rate_deg_s.max() < 1000


@pytest.mark.parametrize("lidar", SCANNERS)
def test_points_compensated_by_the_true_path_lie_on_the_surfaces(lidar: str, monkeypatch: pytest.MonkeyPatch):
    scanner = SCANNERS[lidar]
    noiseless = replace(scanner, model=replace(scanner.model, range_sigma_m=0.0))
    monkeypatch.setitem(recordings.SCANNERS, lidar, noiseless)
    recording = plan(PlatformConfig(scene="office", lidar=lidar, seconds=4.0, seed=5))
    scan = recording.scan(20)
    assert scan.time_offsets_ns is not None
    assert 0.09 * NS_PER_S < np.ptp(scan.time_offsets_ns) < 0.1 * NS_PER_S
    rows = np.linspace(0, len(scan) - 1, 3000).astype(int)
    poses = recording.lidar_poses(recording.scan_times_s[20] + scan.time_offsets_ns[rows] / NS_PER_S)
    in_world = (poses[:, :3, :3] @ scan.points[rows][:, :, None])[..., 0] + poses[:, :3, 3]
    assert distances(recording, in_world).max() < 1e-4
    still = recording.lidar_poses(recording.scan_times_s[[20]])[0]
    assert distances(recording, scan.points[rows] @ still[:3, :3].T + still[:3, 3]).max() > 0.02


@pytest.mark.parametrize("lidar", ["mid360", "rosette"])
def test_sweeps_of_a_non_repetitive_lidar_share_few_rays(lidar: str):
    first, second = (SCANNERS[lidar].sweep(t).directions for t in (0.0, 0.1))
    assert np.linalg.norm(first - second, axis=1).mean() > 0.1


def test_the_lidars_see_what_their_data_sheets_say():
    def angles(name: str) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = SCANNERS[name].sweep(3.0).directions.T
        return np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z))

    azimuth, elevation = angles("mid360")
    assert np.ptp(azimuth) > 355
    assert np.allclose([elevation.min(), elevation.max()], [-7, 52], atol=0.5)
    off_axis = np.degrees(np.arccos(SCANNERS["rosette"].sweep(3.0).directions[:, 0]))
    assert 33 < off_axis.max() < 35.1
    azimuth, elevation = angles("raster")
    assert np.allclose([azimuth.max(), azimuth.min()], [60, -60], atol=0.5)
    assert np.allclose([elevation.max(), elevation.min()], [12.5, -12.5], atol=0.5)
    assert len(SCANNERS["os0"].sweep(0.0).directions) == 64 * 1024


def test_a_start_at_rest_is_at_rest():
    path = plan(PlatformConfig(scene="campus", platform="drone", lidar="vlp-16", seconds=8.0, start_moving=False)).path
    assert np.linalg.norm(path.motion(np.arange(0.0, 0.8, 0.01)).velocity_m_s, axis=1).max() < 0.05
    assert np.linalg.norm(path.motion([6.0]).velocity_m_s) > 2.0


def test_the_noise_of_the_imu_is_that_of_its_grade(monkeypatch: pytest.MonkeyPatch):
    recording = plan(PlatformConfig(scene="stairs", lidar="vlp-16", imu="tactical", seconds=5.0))
    noisy = recording.imu_samples()
    monkeypatch.setitem(recordings.IMU_GRADES, "tactical", ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    exact = recording.imu_samples()
    assert (noisy.gyro_rad_s - exact.gyro_rad_s).std() == pytest.approx(4.4e-5 * np.sqrt(200), rel=0.1)
