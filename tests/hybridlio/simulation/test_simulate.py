"""Simulated drives: files, reproducibility, interrupts, settings."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest
from pydantic import ValidationError

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.simulation import SimulationConfig, simulate
from hybridlio.simulation.kitti_writer import DATE
from hybridlio.simulation.plan import plan
from hybridlio.simulation.rig import T_IMU_LIDAR, T_LIDAR_IMU

TOWN = SimulationConfig(seconds=0.6, seed=5, lidar="16-beam")
SMALL = TOWN.model_copy(update={"scene": "corridor"})


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_the_seed_determines_all_bytes(tmp_path: Path):
    timed = TOWN.model_copy(update={"motion_distortion": True, "gps": True})
    first = contents(simulate(tmp_path / "a", timed).parent)
    again = contents(simulate(tmp_path / "b", timed).parent)
    assert first == again
    other = simulate(tmp_path / "c", timed.model_copy(update={"seed": 6}))
    for part in ("velodyne_points/data/0000000003.bin", "poses.txt", "gps.csv", "oxts/data/0000000002.txt"):
        assert (other / part).read_bytes() != first[f"{DATE}_drive_0005_sync/{part}"], part


def test_the_layout_is_that_of_kitti_raw_data(tmp_path: Path):
    drive = simulate(tmp_path, SMALL)
    assert drive == tmp_path / DATE / f"{DATE}_drive_0005_sync"
    assert len(list((drive / "velodyne_points/data").iterdir())) == 6
    assert len((drive / "velodyne_points/timestamps.txt").read_text().splitlines()) == 6
    row = (drive / "oxts/data/0000000000.txt").read_text().split()
    assert len(row) == 30
    extract = drive.with_name(drive.name.replace("sync", "extract"))
    stamps = (extract / "oxts/timestamps.txt").read_text().splitlines()
    assert len(stamps) == len(list((extract / "oxts/data").iterdir())) == 5 * 10 + 41
    assert stamps[20] == (drive / "velodyne_points/timestamps.txt").read_text().splitlines()[0]
    assert np.fromfile(drive / "velodyne_points/data/0000000000.bin", np.float32).size % 4 == 0
    assert not (drive / "velodyne_points/offsets").exists()


def test_written_poses_are_lidar_poses_in_the_first_scans_frame(tmp_path: Path):
    rows = np.loadtxt(simulate(tmp_path, SMALL) / "poses.txt").reshape(-1, 3, 4)
    drive = plan(SMALL)
    lidar = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    np.testing.assert_allclose(rows, se3.between(lidar[0], lidar)[:, :3], atol=1e-12)


def test_the_lidar_is_mounted_as_on_kittis_car():
    np.testing.assert_allclose(T_LIDAR_IMU @ T_IMU_LIDAR, np.eye(4), atol=1e-12)
    assert np.linalg.norm(T_LIDAR_IMU[:3, 3]) == pytest.approx(1.18, abs=0.05)


class InterruptError(Exception):
    """Raised to interrupt a simulation."""


def test_an_interrupted_drive_is_hidden_and_resumes_to_the_same_bytes(tmp_path: Path):
    def interrupt(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise InterruptError

    with pytest.raises(InterruptError):
        simulate(tmp_path / "a", SMALL, interrupt)
    assert not (tmp_path / "a" / DATE).exists()
    partial = next((tmp_path / "a").glob(".partial-*"))
    scan = next(partial.rglob("0000000001.bin"))
    written = scan.stat().st_mtime_ns
    calls: list[tuple[str, int, int]] = []
    drive = simulate(tmp_path / "a", SMALL, lambda *a: calls.append(a))
    assert (drive / "velodyne_points/data" / scan.name).stat().st_mtime_ns == written
    assert calls == [("", k, 6) for k in range(1, 7)]
    assert contents(drive.parent) == contents(simulate(tmp_path / "b", SMALL).parent)
    assert [p.name for p in (tmp_path / "a").iterdir()] == [DATE]


def test_concurrent_simulations_of_one_drive_write_it_once(tmp_path: Path):
    ready = Barrier(3)

    def begin(_: int) -> Path:
        ready.wait()
        return simulate(tmp_path / "a", SMALL)

    with ThreadPoolExecutor(3) as runs:
        (drive,) = set(runs.map(begin, range(3)))
    assert contents(drive.parent) == contents(simulate(tmp_path / "b", SMALL).parent)
    assert [p.name for p in (tmp_path / "a").iterdir()] == [DATE]


def test_a_drive_interrupted_while_moving_into_place_is_completed(tmp_path: Path):
    drive = simulate(tmp_path, SMALL)
    whole = contents(drive.parent)
    shutil.rmtree(drive)  # the 100 Hz rows arrive first; only they are there
    assert contents(simulate(tmp_path, SMALL).parent) == whole


def test_a_drive_written_before_a_setting_existed_is_reused(tmp_path: Path):
    description = simulate(tmp_path, SMALL) / "simulation.json"
    older = json.loads(description.read_text())
    del older["config"]["driving"]
    description.write_text(json.dumps(older))
    simulate(tmp_path, SMALL)
    with pytest.raises(DataError, match="another drive"):
        simulate(tmp_path, SMALL.model_copy(update={"driving": "hard"}))


def test_a_drive_has_the_requested_length():
    drive = plan(SMALL.model_copy(update={"seconds": None, "length_m": 150.0}))
    position = drive.path.poses(drive.scan_times_s)[:, :3, 3]
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).sum() == pytest.approx(150.0, abs=3.0)


@pytest.mark.parametrize(("seed", "scene"), [(3, "town"), (2, "field"), (9, "field")])
def test_a_drive_with_loops_has_the_requested_length_without_waiting_at_the_end(seed: int, scene: str):
    settings = {"seed": seed, "scene": scene, "loops": True, "length_m": 600.0, "traffic_per_km": 0.0}
    drive = plan(SimulationConfig.model_validate(settings))
    position = drive.path.poses(drive.scan_times_s)[:, :3, 3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    assert steps.sum() == pytest.approx(600.0, rel=0.01)
    assert steps[-50:].sum() > 1.0


def test_misspelt_or_impossible_settings_are_rejected():
    for wrong in ({"second": 3.0}, {"lidar": "vlp-17"}, {"seconds": -1.0}, {"scene": "moon"}, {"seed": -1}):
        with pytest.raises(ValidationError):
            SimulationConfig(**wrong)


def test_a_missing_pose_file_is_named_in_the_error(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"no pose file at .*nowhere\.txt"):
        simulate(tmp_path, SMALL.model_copy(update={"poses": Path("nowhere.txt")}))
