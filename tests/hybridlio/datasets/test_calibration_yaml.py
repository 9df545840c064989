"""What ``calibration.yaml`` states: transforms in every form, sensors, clocks, and the meaning of columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.core.sensors import ImuNoise
from hybridlio.datasets import open_sequence
from hybridlio.datasets.calibration_yaml import StatedCalibration, read_calibration_yaml
from hybridlio.datasets.points.point_times import StatedTimes


def read(tmp_path: Path, **content: Any) -> StatedCalibration:
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    return read_calibration_yaml(path)


FORMS = {
    "quaternion_xyzw": lambda R: R.as_quat().tolist(),
    "quaternion_wxyz": lambda R: np.roll(R.as_quat(), 1).tolist(),
    "roll_pitch_yaw_deg": lambda R: R.as_euler("ZYX", degrees=True)[::-1].tolist(),
    "roll_pitch_yaw_rad": lambda R: R.as_euler("ZYX")[::-1].tolist(),
    "rotation": lambda R: R.as_matrix().tolist(),
}


class TestTransforms:
    @pytest.mark.parametrize("form", FORMS)
    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("key", ["T_imu_lidar", "T_camera_lidar"])
    def test_every_form_gives_the_same_transform(self, tmp_path: Path, form: str, seed: int, key: str) -> None:
        R = Rotation.random(rng=np.random.default_rng(seed))
        stated = read(tmp_path, **{key: {"translation": [1, -2, 0.5], form: FORMS[form](R)}})
        expected = se3.make(R.as_matrix(), [1, -2, 0.5])
        np.testing.assert_allclose(getattr(stated.calibration, key), expected, atol=1e-12)

    def test_yaw_turns_about_z_from_x_to_y(self, tmp_path: Path) -> None:
        stated = read(tmp_path, T_imu_lidar={"translation": [0, 0, 0], "roll_pitch_yaw_deg": [0, 0, 90]})
        np.testing.assert_allclose(stated.calibration.T_imu_lidar @ [1, 0, 0, 1], [0, 1, 0, 1], atol=1e-12)

    @pytest.mark.parametrize(
        ("value", "says"),
        [
            ([0.1, 0, 0.2, 0, 0, 0, 1], "do not say the order of the quaternion"),
            ({"translation": [0, 0, 0]}, "one of quaternion_xyzw"),
            ({"quaternion_xyzw": [0, 0, 0, 1]}, "expected 'translation'"),
            ({"translation": [0, 0, 0], "quaternion": [0, 0, 0, 1]}, "one of quaternion_xyzw"),
            ({"translation": [0, 0], "quaternion_xyzw": [0, 0, 0, 1]}, "three numbers in metres"),
            ({"translation": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}, "has the norm 2.000"),
            ({"translation": [0, 0, 0], "quaternion_xyzw": [0, 0, 1]}, "4 finite numbers"),
            ({"translation": [0, 0, 0], "roll_pitch_yaw_deg": [0, 0, "left"]}, "3 finite numbers"),
            (
                {"translation": [0, 0, 0], "rotation": np.eye(3).tolist(), "quaternion_xyzw": [0, 0, 0, 1]},
                "expected 'translation' and one of",
            ),
            ({"translation": [0, 0, 0], "rotation": np.diag([1, 1, -1]).tolist()}, "not a rigid transform"),
        ],
    )
    def test_other_forms_are_refused(self, tmp_path: Path, value: Any, says: str) -> None:
        with pytest.raises(DataError, match=rf"calibration\.yaml: T_imu_lidar.*{says}"):
            read(tmp_path, T_imu_lidar=value)


class TestSensors:
    def test_noise_and_the_lidars_limits_are_read(self, tmp_path: Path) -> None:
        stated = read(
            tmp_path,
            imu_noise={"gyro_rad_s_sqrt_hz": 2e-3},
            lidar={"model": "16-beam", "min_range_m": 2, "max_range_m": 60},
        )
        assert stated.imu_noise == ImuNoise(gyro_rad_s_sqrt_hz=2e-3)
        assert stated.lidar is not None
        assert (stated.lidar.min_range_m, stated.lidar.max_range_m) == (2.0, 60.0)
        assert stated.lidar.elevations_deg == LIDAR_MODELS["16-beam"].elevations_deg
        assert stated.format.limits_m == (2.0, 60.0)
        assert read(tmp_path, lidar="16-beam").format.limits_m is None

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("imu_noise", {"gyro": 1}),
            ("imu_noise", {"gyro_rad_s_sqrt_hz": -1}),
            ("imu_noise", {"gyro_rad_s_sqrt_hz": "small"}),
            ("lidar", {"model": "hdl-9"}),
            ("lidar", {"range": 4}),
            ("lidar", {"min_range_m": 5, "max_range_m": 4}),
            ("imu_time_offset_s", "0.1 s"),
            ("imu_time_offset_s", float("nan")),
            ("imu_scale", {"gyro": [1, 1, 1]}),
            ("imu_scale", {"gyro": "one"}),
            ("imu_scale", {"gyroscope": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}),
            ("rate_hz", 0),
            ("rate_hz", True),
            ("columns", ["x", "y"]),
            ("point_times", {"unit": "minutes"}),
            ("point_times", {"origin": "noon"}),
            ("point_times", {"sweep_s": -1}),
            ("point_times", "all"),
        ],
    )
    def test_malformed_values_name_the_file_and_the_key(self, tmp_path: Path, key: str, value: Any) -> None:
        with pytest.raises(DataError, match=rf"calibration\.yaml: (unknown )?{key}"):
            read(tmp_path, **{key: value})

    def test_point_times_are_stated_or_ignored(self, tmp_path: Path) -> None:
        stated = read(tmp_path, point_times={"column": "T", "unit": "µs", "origin": "end", "sweep_s": 0.1})
        assert stated.format.times == StatedTimes("t", "us", "end", 0.1)
        assert read(tmp_path, point_times="none").format.times == StatedTimes(ignored=True)


class TestInAFolder:
    def append(self, folder: Path, text: str) -> None:
        with (folder / "calibration.yaml").open("a") as file:
            file.write(text)

    def test_the_imus_stamps_are_moved_by_the_stated_offset(self, recordings: Any, tmp_path: Path) -> None:
        folder = recordings.write_folder(tmp_path, recordings.ride)
        before = open_sequence(folder).imu.stamps_ns
        self.append(folder, "imu_time_offset_s: -0.0123\n")
        sequence = open_sequence(folder)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, before - 12_300_000)
        assert any("moved by -0.012300 s" in note for note in sequence.notes)

    def test_the_imus_samples_are_corrected_by_the_stated_scale(self, recordings: Any, tmp_path: Path) -> None:
        folder = recordings.write_folder(tmp_path, recordings.ride)
        before = open_sequence(folder).imu
        self.append(folder, "imu_scale: {gyro: [[1.01, 0, 0.02], [0, 1, 0], [0, 0, 1]]}\n")
        sequence = open_sequence(folder)
        gyro = before.gyro_rad_s + before.gyro_rad_s @ np.array([[0.01, 0, 0], [0, 0, 0], [0.02, 0, 0]])
        np.testing.assert_allclose(sequence.imu.gyro_rad_s, gyro)
        np.testing.assert_array_equal(sequence.imu.accel_m_s2, before.accel_m_s2)
        assert any("corrected by the scale" in note for note in sequence.notes)

    @pytest.mark.parametrize(("stated", "sigma"), [("", 0.003), ("imu_noise: {gyro_scale_sigma: 0.001}\n", 0.001)])
    def test_a_stated_scale_is_believed_unless_its_error_is_stated_too(
        self, recordings: Any, tmp_path: Path, stated: str, sigma: float
    ) -> None:
        folder = recordings.write_folder(tmp_path, recordings.ride)
        self.append(folder, "imu_scale: {gyro: [[1.01, 0, 0], [0, 1, 0], [0, 0, 1]]}\n" + stated)
        assert open_sequence(folder).imu_noise == ImuNoise(gyro_scale_sigma=sigma)

    def test_noise_and_ranges_reach_the_frames(self, recordings: Any, tmp_path: Path) -> None:
        folder = recordings.write_folder(tmp_path, recordings.ride)
        self.append(folder, "imu_noise: {accel_m_s2_sqrt_hz: 0.05}\nlidar: {min_range_m: 8, max_range_m: 20}\n")
        frame = open_sequence(folder)[2]
        assert frame.imu_noise == ImuNoise(accel_m_s2_sqrt_hz=0.05)
        ranges = np.linalg.norm(frame.scan.points, axis=1)
        assert 8 <= ranges.min() < ranges.max() <= 20

    def test_a_folder_of_scans_alone_opens_at_a_stated_rate(self, recordings: Any, tmp_path: Path) -> None:
        for k in range(5):
            recordings.put_bin(tmp_path / f"bare/{k}.bin", recordings.ride.points(k))
        with pytest.raises(DataError, match=r"give --rate 10 \('rate_hz: 10' in calibration\.yaml\)"):
            open_sequence(tmp_path / "bare")
        (tmp_path / "bare/calibration.yaml").write_text("rate_hz: 20\n")
        sequence = open_sequence(tmp_path / "bare")
        np.testing.assert_array_equal(np.diff(sequence.stamps_ns), 50_000_000)
        assert any("20 a second, from 0 s" in note for note in sequence.notes)

    def test_the_rate_given_when_opening_comes_before_that_in_the_file(self, recordings: Any, tmp_path: Path) -> None:
        for k in range(5):
            recordings.put_bin(tmp_path / f"bare/{k}.bin", recordings.ride.points(k))
        (tmp_path / "bare/calibration.yaml").write_text("rate_hz: 20\n")
        np.testing.assert_array_equal(np.diff(open_sequence(tmp_path / "bare", rate_hz=10).stamps_ns), 100_000_000)
        for wrong in (0.0, -1.0, 1e9, float("nan")):
            with pytest.raises(ConfigError, match="rate_hz: must be above 0"):
                open_sequence(tmp_path / "bare", rate_hz=wrong)

    def test_stated_columns_and_times_of_bin_scans_are_used(self, recordings: Any, tmp_path: Path) -> None:
        folder = recordings.write_folder(tmp_path, recordings.ride)
        times = np.linspace(0, 99_000, 60)
        for k, path in enumerate(sorted((folder / "scans").iterdir())):
            path.unlink()
            points = np.column_stack([np.zeros(60), times, np.random.default_rng(k).uniform(-9, 9, (60, 3))])
            recordings.put_bin(folder / f"scans/{k}.bin", points)
        self.append(folder, "columns: [_, t, x, y, z]\npoint_times: {origin: end}\n")
        scan = open_sequence(folder)[3].scan
        np.testing.assert_allclose(scan.time_offsets_ns, (times - 99_000) * 1000, atol=10)
        assert np.abs(scan.points).max() < 9


class TestFrames:
    T_base_imu = se3.exp([0.1, -0.2, 0.3, 0.2, -0.1, 0.5])
    T_base_lidar = se3.exp([-0.3, 0.1, 2.0, 1.0, 0.0, 1.5])

    def frames(self, **names: Any) -> dict[str, Any]:
        R = Rotation.from_matrix(self.T_base_imu[:3, :3])
        imu = {"translation": self.T_base_imu[:3, 3].tolist(), "quaternion_xyzw": R.as_quat().tolist()}
        return {
            "frames": [
                {"parent": "base_link", "child": "imu", **imu},
                {"parent": "base_link", "child": "lidar", "T_parent_child": self.T_base_lidar.tolist()},
            ],
            "imu_frame": "imu",
            "lidar_frame": "lidar",
            **names,
        }

    def test_a_tree_of_frames_states_the_extrinsics(self, tmp_path: Path) -> None:
        found = read(tmp_path, **self.frames())
        expected = se3.inverse(self.T_base_imu) @ self.T_base_lidar
        np.testing.assert_allclose(found.calibration.T_imu_lidar, expected, atol=1e-12)
        assert "T_imu_lidar" in found.keys

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"lidar_frame": "velodyne"}, "do not connect 'imu' and 'velodyne'; they are base_link, imu, lidar"),
            ({"lidar_frame": None}, "frames need imu_frame and lidar_frame"),
            ({"T_imu_lidar": np.eye(4).tolist()}, "state the same; keep one"),
            ({"frames": [{"parent": "a"}]}, "entry 0 lacks parent, child"),
            ({"frames": "tf.yaml"}, "expected a list of transforms"),
        ],
    )
    def test_frames_that_state_nothing_are_refused(self, tmp_path: Path, change: Any, message: str) -> None:
        with pytest.raises(DataError, match=message):
            read(tmp_path, **self.frames(**change))


def test_a_vehicle_is_a_box_in_the_lidar_frame(tmp_path: Path) -> None:
    box = read(tmp_path, vehicle={"min": [-1, -1, -2], "max": [2, 1, 0.5]}).format.vehicle
    assert box is not None
    assert (box.low_m, box.high_m) == ((-1.0, -1.0, -2.0), (2.0, 1.0, 0.5))
    with pytest.raises(DataError, match="each number of min must be below that of max"):
        read(tmp_path, vehicle={"min": [1, -1, -2], "max": [-1, 1, 0.5]})
