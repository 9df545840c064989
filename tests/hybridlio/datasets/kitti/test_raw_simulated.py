"""KITTI raw drives with the files that the simulator adds."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.core.sensors import ImuNoise
from hybridlio.core.trajectory import Trajectory, write_kitti
from hybridlio.datasets import open_sequence

MS = 1_000_000


class TestSimulatorsAdditions:
    def test_exact_poses_take_precedence_over_navigation_rows(self, recordings: Any, drive: Path) -> None:
        exact = recordings.ride.lidar.poses.copy()
        exact[:, 0, 3] *= 1.01
        write_kitti(drive / "poses.txt", Trajectory(recordings.ride.stamps_ns, exact))
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, exact, atol=1e-11)

    def test_too_few_poses_are_rejected(self, recordings: Any, drive: Path) -> None:
        ride = recordings.ride
        write_kitti(drive / "poses.txt", Trajectory(ride.stamps_ns[:-1], ride.lidar.poses[:-1]))
        with pytest.raises(DataError, match=r"poses\.txt"):
            open_sequence(drive)

    def test_lidar_and_imu_noise_come_from_simulation_json(self, drive: Path) -> None:
        noise = ImuNoise(gyro_rad_s_sqrt_hz=3e-4)
        (drive / "simulation.json").write_text(json.dumps({"lidar": "16-beam", "imu_noise": asdict(noise), "seed": 1}))
        sequence = open_sequence(drive)
        assert sequence.lidar is LIDAR_MODELS["16-beam"]
        assert sequence.imu_noise == noise

    @pytest.mark.parametrize(
        "content",
        [
            *("{", '{"lidar": "hdl-9"}', "[]"),
            *(f'{{"lidar": "16-beam", "imu_noise": {noise}}}' for noise in ('{"gyro_rad_s_sqrt_hz": -1}', "[1]", "7")),
        ],
    )
    def test_a_malformed_simulation_json_is_named_in_the_error(self, drive: Path, content: str) -> None:
        (drive / "simulation.json").write_text(content)
        with pytest.raises(DataError, match=r"simulation\.json"):
            open_sequence(drive)

    def test_frames_hold_the_fixes_since_the_previous_scan(self, recordings: Any, drive: Path) -> None:
        stamps = recordings.ride.stamps_ns[[0, 3, 3, 11]] + np.array([-MS, 0, 1, 5])
        rows = [f"{t},{k},{2 * k},{3 * k},{0.5 * k}" for k, t in enumerate(stamps)]
        (drive / "gps.csv").write_text("\n".join(["stamp_ns,east,north,up,sigma", *rows]))
        sequence = open_sequence(drive)
        assert [[fix.stamp_ns for fix in frame.gps] for frame in sequence][:5] == [
            *[[stamps[0]], [], []],
            *[[stamps[1]], [stamps[2]]],
        ]
        fix = sequence[4].gps[0]
        np.testing.assert_array_equal(fix.position_m, [2, 4, 6])
        np.testing.assert_array_equal(fix.covariance_m2, np.eye(3))
        np.linalg.cholesky(sequence[0].gps[0].covariance_m2)

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            ("stamp_ns,east,north,sigma\n1,2,3,4\n", "lacks up"),
            ("stamp_ns,east,north,up,sigma\n1,2,3,4,5\n1,2,x,4,5\n", "line 3"),
            ("stamp_ns,east,north,up,sigma\n1,2,nan,4,5\n", "line 2"),
            ("stamp_ns,east,north,up,sigma\n1,2\n", "line 2"),
        ],
    )
    def test_the_error_names_the_line_of_a_malformed_fix(self, drive: Path, content: str, says: str) -> None:
        (drive / "gps.csv").write_text(content)
        with pytest.raises(DataError, match=rf"gps\.csv.*{says}"):
            open_sequence(drive)

    def test_points_have_times_if_the_drive_has_offsets(self, recordings: Any, drive: Path) -> None:
        folder = drive / "velodyne_points/offsets"
        folder.mkdir()
        offsets = np.arange(len(recordings.ride.points(1)), dtype=np.int64) * 1000 - 20_000
        np.save(folder / "0000000001.npy", offsets)
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence[1].scan.time_offsets_ns, offsets)
        with pytest.raises(DataError, match=r"frame 2: .*0000000002\.npy"):
            sequence[2]
        np.save(folder / "0000000002.npy", offsets[:-5])
        with pytest.raises(DataError, match=r"frame 2: .*time_offsets_ns"):
            sequence[2]

    def test_a_simulated_drive_is_read_completely(self, tmp_path: Path) -> None:
        pytest.importorskip("open3d")
        from hybridlio.simulation.config import SimulationConfig
        from hybridlio.simulation.simulate import simulate

        config = SimulationConfig(seconds=1.0, lidar="16-beam", motion_distortion=True, gps=True)
        drive = simulate(tmp_path, config)
        sequence = open_sequence(tmp_path)
        assert sequence.notes == ()
        assert sequence.lidar is LIDAR_MODELS["16-beam"]
        assert sequence.imu_noise == config.imu_noise
        assert [len(frame.imu) for frame in sequence][1:] == [11] * (len(sequence) - 1)
        assert all(frame.scan.time_offsets_ns is not None for frame in sequence)
        assert sequence[0].gps
        # the navigation rows say the same as the exact poses, through the projection and the calibration
        exact = sequence.reference
        (drive / "poses.txt").unlink()
        from_rows = open_sequence(tmp_path).reference
        assert exact is not None
        assert from_rows is not None
        np.testing.assert_allclose(from_rows.poses, exact.poses, atol=1e-5)
