"""Recordings of platforms as folders: what is read is what was planned, and errors say what to do."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.core.errors import DataError
from hybridlio.datasets.registry import open_sequence
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.recording import plan
from hybridlio.simulation.platforms.simulate import simulate_platform

CONFIG = PlatformConfig(scene="stairs", lidar="mid360", seconds=0.5, seed=7)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_platform(tmp_path_factory.mktemp("platforms"), CONFIG)


def test_reading_returns_what_was_planned(folder: Path):
    sequence, planned = open_sequence(folder), plan(CONFIG)
    assert len(sequence) == 5
    np.testing.assert_array_equal(sequence.stamps_ns, planned.scan_stamps_ns)
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar, planned.T_imu_lidar, atol=1e-12)
    np.testing.assert_allclose(sequence.imu.accel_m_s2, planned.imu_samples().accel_m_s2, atol=1e-6)
    np.testing.assert_allclose(sequence.reference.poses, planned.reference().poses, atol=1e-8)
    read, scan = sequence[2].scan, planned.scan(2)
    np.testing.assert_array_equal(read.points, scan.points)
    np.testing.assert_array_equal(read.time_offsets_ns, scan.time_offsets_ns)


def test_the_same_settings_give_the_same_bytes(folder: Path, tmp_path: Path):
    again = simulate_platform(tmp_path, CONFIG)
    files = [p.relative_to(folder) for p in sorted(folder.rglob("*")) if p.is_file()]
    assert len(files) == 5 + 5
    assert all((folder / name).read_bytes() == (again / name).read_bytes() for name in files)


def test_an_interrupted_simulation_continues(folder: Path, tmp_path: Path):
    def stop(_: str, done: int, __: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_platform(tmp_path, CONFIG, stop)
    assert not (tmp_path / CONFIG.name).exists()
    again = simulate_platform(tmp_path, CONFIG)
    assert (again / "scans/000004.npy").read_bytes() == (folder / "scans/000004.npy").read_bytes()


def test_a_recording_with_other_settings_is_not_replaced(folder: Path):
    other = PlatformConfig(scene="stairs", lidar="mid360", seconds=0.6, seed=7)
    with pytest.raises(DataError, match="other settings; choose another folder or seed"):
        simulate_platform(folder.parent, other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scene", "moon"], "unknown scene 'moon'; choose one of town, corridor, field, office"),
        (["--scene", "office", "--lidar", "hdl"], "unknown lidar 'hdl'; choose one of os0"),
        (["--scene", "office", "--platform", "ship"], "unknown platform 'ship'; choose one of handheld"),
        (["--scene", "office", "--imu", "x"], "unknown imu 'x'; choose one of consumer-mems, industrial, tactical"),
        (["--scene", "office", "--gps"], "--gps is for roads (town, corridor, field), not for 'office'"),
        (["--platform", "drone"], "--platform is for the scenes of other platforms, not for the road 'town'"),
    ],
)
def test_the_command_says_what_is_wrong(options: list[str], message: str, tmp_path: Path):
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "out"), *options])
    assert result.exit_code != 0
    assert message in " ".join(result.output.split())


def test_the_command_writes_a_recording(tmp_path: Path):
    words = ["simulate", str(tmp_path), "--scene", "office", "--lidar", "vlp-16", "--seconds", "0.5", "--seed", "2"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "office-handheld-vlp-16-2: 5 scans" in result.output
