"""Recordings are prepared once as shards, also by concurrent processes."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from hybridlio.cloud.map_geometry import MAP_GEOMETRIES
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import ImuNoise, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.learned.settings import NetworkSettings, Recipe
from hybridlio.runs.run import run_odometry
from hybridlio.runs.training import training_data
from hybridlio.runs.training.training_data import DataOptions, prepare_shards, shard_name, training_pairs

NETWORK = NetworkSettings(geometry=MAP_GEOMETRIES["16-beam"])
RECIPE = Recipe(network=NETWORK)
GIVEN = Recipe(network=replace(NETWORK, imu="given"))
MOVING = Recipe(network=replace(NETWORK, velocity=True, siamese="twins"))


@pytest.fixture(scope="module")
def options(tmp_path_factory) -> DataOptions:
    return DataOptions(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def given(tiny_drive, options):
    """The drive's shard with initial poses and velocities."""
    return prepare_shards([tiny_drive], GIVEN, options)[0]


def test_a_recording_is_prepared_once_and_found_again(tiny_drive, options, given):
    stamp = (given.folder / "shard.json").stat().st_mtime_ns
    reports = []
    again = prepare_shards([tiny_drive], GIVEN, options, lambda *where: reports.append(where))
    assert [shard.folder for shard in again] == [given.folder]
    assert (given.folder / "shard.json").stat().st_mtime_ns == stamp
    assert reports == []
    assert len(given) == len(open_sequence(tiny_drive))


def test_shards_and_folders_of_shards_are_accepted_as_data(options, given):
    assert given.folder in [shard.folder for shard in prepare_shards([options.cache], GIVEN, options)]
    assert [shard.folder for shard in prepare_shards([given.folder], GIVEN, options)] == [given.folder]


def test_given_initial_poses_come_from_an_odometry_run_and_not_from_the_reference(tiny_drive, given):
    sequence = open_sequence(tiny_drive)
    true = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    off = np.linalg.norm(se3.log(se3.between(given.initial[3:], true[2:]))[:, 3:], axis=1)
    assert off.min() > 1e-5
    assert off.max() < 0.15
    # the speed is unknown at the first step
    assert np.isnan(given.initial[:2]).all()


def test_the_velocity_comes_from_the_steps_of_the_odometry(tiny_drive, given):
    sequence = open_sequence(tiny_drive)
    true = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    ahead = np.array([T[:3, :3].T @ T[:3, 3] for T in true]) / 0.1
    assert np.allclose(given.velocity_m_s[3:], ahead[1:-1], atol=0.3)
    assert not np.allclose(given.velocity_m_s[3:], ahead[1:-1], atol=1e-4)


def test_a_poorly_constrained_step_gives_no_velocity(tiny_drive, tmp_path, monkeypatch):
    def half_blind(*args):
        run = run_odometry(*args)
        lost = [replace(e, relative=e.relative.wider(added=np.eye(6))) if e.index == 4 else e for e in run.estimates]
        return replace(run, estimates=lost)

    monkeypatch.setattr(training_data, "run_odometry", half_blind)
    shard = prepare_shards([tiny_drive], MOVING, DataOptions(tmp_path))[0]
    known = np.isfinite(shard.velocity_m_s).all(axis=1)
    assert not known[5]  # the fourth step leads to this scan
    assert known[2:5].all()
    assert known[6:].all()


def later_larger(scan: Scan, k: int) -> Scan:
    return scan if k == 0 else replace(scan, points=1.1 * scan.points)


def test_shard_names_differ_by_data_geometry_and_source(tiny_drive):
    sequence = open_sequence(tiny_drive)
    names = {
        shard_name(sequence, RECIPE),
        shard_name(replace(sequence, reference=None), RECIPE),
        shard_name(sequence.part(0, 9), RECIPE),
        shard_name(sequence, GIVEN, "kalman"),
        shard_name(sequence, GIVEN, "preintegration"),
        shard_name(sequence, Recipe(network=replace(NETWORK, geometry=MAP_GEOMETRIES["32-beam"]))),
        shard_name(sequence, replace(RECIPE, loss=replace(RECIPE.loss, keep_ground=True))),
    }
    assert len(names) == 7
    imu = sequence.imu
    others = {
        shard_name(other, RECIPE)
        for other in (
            replace(sequence, imu=replace(imu, accel_m_s2=9.81 * imu.accel_m_s2)),
            replace(sequence, imu=replace(imu, stamps_ns=imu.stamps_ns + 50_000_000)),
            replace(sequence, imu_noise=ImuNoise(gyro_rad_s_sqrt_hz=0.1)),
            replace(sequence, load_scan=lambda k: later_larger(sequence.load_scan(k), k)),
        )
    }
    assert len(others - names) == 4
    assert shard_name(sequence, GIVEN, "preintegration") == shard_name(sequence, MOVING) == shard_name(sequence, GIVEN)
    # a network without initial pose and velocity as input needs no odometry, so that its source does not matter
    assert shard_name(sequence, RECIPE, "kalman") == shard_name(sequence, RECIPE)


def test_concurrent_processes_prepare_a_shard_once(tiny_drive, tmp_path, project_root):
    code = (
        "import sys; from pathlib import Path\n"
        "from hybridlio.learned.settings import NetworkSettings, Recipe\n"
        "from hybridlio.cloud.map_geometry import MAP_GEOMETRIES\n"
        "from hybridlio.runs.training.training_data import DataOptions, prepare_shards\n"
        "reports = []\n"
        "recipe = Recipe(network=NetworkSettings(geometry=MAP_GEOMETRIES['16-beam']))\n"
        "shards = prepare_shards([Path(sys.argv[1])], recipe,\n"
        "                   DataOptions(Path(sys.argv[2])), lambda *where: reports.append(where))\n"
        "print(len(shards[0]), bool(reports))\n"
    )
    command = [sys.executable, "-c", code, str(tiny_drive), str(tmp_path / "cache")]
    both = [subprocess.Popen(command, cwd=project_root, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    output = sorted(process.communicate(timeout=120)[0].split() for process in both)
    assert output == [["25", "False"], ["25", "True"]]
    assert len(list((tmp_path / "cache").glob("*/shard.json"))) == 1


def test_the_error_for_a_path_without_recordings_names_it(tmp_path, options):
    with pytest.raises(DataError, match="nowhere"):
        prepare_shards([tmp_path / "nowhere"], RECIPE, options)


def test_an_unknown_split_is_an_error(tiny_drive, options):
    with pytest.raises(ConfigError, match="easy, hard"):
        training_pairs([tiny_drive], None, "middling", RECIPE, options)


def test_a_shard_records_the_source_of_its_initial_poses(given):
    assert "preintegration" in json.loads((given.folder / "shard.json").read_text())["made_by"]
