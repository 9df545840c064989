"""Correction of vertical angles: the geometry in closed form, and which recordings are corrected."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core.errors import ConfigError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.kitti.vertical_angle import KITTI_VERTICAL_ANGLE_DEG, raise_points


def cloud(rng: np.random.Generator, count: int = 5000) -> Any:
    return rng.uniform([-60, -60, -3], [60, 60, 10], (count, 3)).astype(np.float32)


def elevation_deg(points: Any) -> Any:
    points = np.asarray(points, dtype=np.float64)
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


@pytest.mark.parametrize("angle_deg", [0.205, -0.3, 2.0])
def test_elevations_increase_by_the_angle_and_ranges_and_azimuths_stay(
    rng: np.random.Generator, angle_deg: float
) -> None:
    points = cloud(rng)
    raised = raise_points(points, angle_deg)
    assert raised.dtype == np.float32
    np.testing.assert_allclose(elevation_deg(raised) - elevation_deg(points), angle_deg, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(points, axis=1), rtol=1e-6)
    np.testing.assert_allclose(
        np.arctan2(raised[:, 1], raised[:, 0]), np.arctan2(points[:, 1], points[:, 0]), atol=1e-6
    )


def test_points_rotate_about_the_horizontal_axis_perpendicular_to_them(rng: np.random.Generator) -> None:
    points = cloud(rng, 200)
    axes = np.cross(points.astype(float), [0, 0, 1])
    axes *= np.radians(0.205) / np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(raise_points(points, 0.205), Rotation.from_rotvec(axes).apply(points), atol=1e-5)


def test_raising_points_flattens_the_cone_of_flat_ground(rng: np.random.Generator) -> None:
    ground = cloud(rng)
    ground[:, 2] = -1.73
    cone = raise_points(ground, -0.205)
    assert np.ptp(cone[:, 2]) > 0.2
    np.testing.assert_allclose(raise_points(cone, 0.205)[:, 2], -1.73, atol=1e-5)


def test_points_on_the_vertical_axis_and_at_the_origin_stay_finite() -> None:
    points = np.array([[0, 0, 4], [0, 0, -4], [0, 0, 0]], np.float32)
    np.testing.assert_allclose(raise_points(points, 0.205), points, atol=3e-5)


class TestWhichRecordings:
    @pytest.mark.parametrize("write", ["write_raw", "write_odometry", "write_folder"])
    def test_every_reader_applies_the_given_angle(self, recordings: Any, tmp_path: Path, write: str) -> None:
        path = getattr(recordings, write)(tmp_path, recordings.ride)
        plain, asked = open_sequence(path), open_sequence(path, vertical_angle_deg=0.4)
        for k in (0, 5):
            np.testing.assert_array_equal(asked[k].scan.points, raise_points(plain[k].scan.points, 0.4))
            np.testing.assert_array_equal(asked[k].scan.intensity, plain[k].scan.intensity)
        again = pickle.loads(pickle.dumps(asked))
        np.testing.assert_array_equal(again[3].scan.points, asked[3].scan.points)

    @pytest.mark.parametrize("angle_deg", [5.1, -90.0, float("nan"), float("inf")])
    def test_angles_over_5_degrees_are_rejected(self, recordings: Any, tmp_path: Path, angle_deg: float) -> None:
        path = recordings.write_raw(tmp_path, recordings.ride)
        with pytest.raises(ConfigError, match="vertical_angle_deg"):
            open_sequence(path, vertical_angle_deg=angle_deg)

    def test_kitti_drives_are_corrected_by_default(self, kitti_raw_root: Path) -> None:
        for name in ("0005", "0048", "0060"):
            sequence = open_sequence(kitti_raw_root, sequence=name)
            plain = open_sequence(kitti_raw_root, sequence=name, vertical_angle_deg=0)
            expected = raise_points(plain[3].scan.points, KITTI_VERTICAL_ANGLE_DEG)
            np.testing.assert_array_equal(sequence[3].scan.points, expected)
            assert any("0.205" in note for note in sequence.notes)
            assert not any("0.205" in note for note in plain.notes)

    def test_kitti_odometry_sequences_are_corrected_by_default(self, kitti_odometry_root: Path) -> None:
        sequence = open_sequence(kitti_odometry_root, sequence="00")
        plain = open_sequence(kitti_odometry_root, sequence="00", vertical_angle_deg=0)
        expected = raise_points(plain[3].scan.points, KITTI_VERTICAL_ANGLE_DEG)
        np.testing.assert_array_equal(sequence[3].scan.points, expected)

    def test_an_unreadable_first_scan_is_skipped(self, kitti_raw_root: Path, tmp_path: Path) -> None:
        date = tmp_path / "2011_09_26"
        shutil.copytree(kitti_raw_root / date.name, date, ignore=shutil.ignore_patterns("*0005*", "*0060*"))
        drive = date / "2011_09_26_drive_0048_sync"
        (drive / "velodyne_points/data/0000000000.bin").write_bytes(b"")
        assert any("0.205" in note for note in open_sequence(drive).notes)

    def test_other_scans_with_kitti_calibration_are_not_corrected(
        self, recordings: Any, kitti_raw_root: Path, kitti_odometry_root: Path, tmp_path: Path
    ) -> None:
        raw = recordings.write_raw(tmp_path, recordings.ride, name="2011_09_26_drive_0005")
        shutil.copy(kitti_raw_root / "2011_09_26/calib_imu_to_velo.txt", raw.parent)
        odometry = recordings.write_odometry(tmp_path / "odometry", recordings.ride, name="00")
        shutil.copy(kitti_odometry_root / "sequences/00/calib.txt", odometry)
        for path in (raw, odometry):
            sequence = open_sequence(path)
            written = recordings.ride.points(2)[:, :3].astype(np.float32)
            np.testing.assert_array_equal(sequence[2].scan.points, written)
            assert not any("0.205" in note for note in sequence.notes)

    def test_simulated_scans_with_kitti_calibration_are_not_corrected(
        self, kitti_raw_root: Path, tmp_path: Path
    ) -> None:
        from hybridlio.simulation import SimulationConfig, simulate

        drive = simulate(tmp_path, SimulationConfig(seconds=0.3, seed=3))
        shutil.copy(kitti_raw_root / "2011_09_26/calib_imu_to_velo.txt", drive.parent)
        (drive / "simulation.json").unlink()
        assert not any("0.205" in note for note in open_sequence(drive).notes)

    def test_kitti_scans_with_another_calibration_are_not_corrected(
        self, recordings: Any, kitti_raw_root: Path, tmp_path: Path
    ) -> None:
        drive = recordings.write_raw(tmp_path, recordings.ride)
        own = kitti_raw_root / "2011_09_26/2011_09_26_drive_0048_sync/velodyne_points/data"
        for k in range(recordings.ride.count):
            shutil.copy(own / f"{k:010d}.bin", drive / "velodyne_points/data")
        assert not any("0.205" in note for note in open_sequence(drive).notes)
