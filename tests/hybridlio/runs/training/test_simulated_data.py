"""Simulated drives become shards without files of their own, once, and differ as much as training needs."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.presets import preset
from hybridlio.runs.training import simulated_data
from hybridlio.runs.training.simulated_data import drive_name, prepare_drives, simulated_drives
from hybridlio.runs.training.training_data import DataOptions
from hybridlio.simulation.recording import simulated_recording
from hybridlio.simulation.training_drives import training_drive

RECIPE = preset("published")
COARSE = replace(LIDAR_MODELS["16-beam"], columns=180)


@pytest.fixture(scope="module")
def drive():
    config, _ = training_drive(7, 1.5, "16-beam")
    return config.model_copy(update={"scene": "town", "start_moving": True, "speed_m_s": 8.0}), COARSE


@pytest.fixture(scope="module")
def prepared(drive, tmp_path_factory):
    options = DataOptions(tmp_path_factory.mktemp("cache"))
    return options, prepare_drives([drive], RECIPE, options)[0]


def test_a_drives_shard_holds_its_scans_its_true_steps_and_velocities_by_odometry(drive, prepared):
    _, shard = prepared
    recording = simulated_recording(*drive)
    assert len(shard) == len(recording)
    true = np.linalg.inv(recording.reference.poses[:-1]) @ recording.reference.poses[1:]
    assert np.allclose(shard.reference[1:], true, atol=1e-5)
    known = np.isfinite(shard.velocity_m_s).all(axis=1)
    assert known.sum() >= len(shard) - 3
    speeds = np.linalg.norm(true[:, :3, 3], axis=1) * 10
    found = np.linalg.norm(shard.velocity_m_s[3:], axis=1)
    assert np.nanmax(np.abs(found - speeds[1:-1])) < 0.3
    assert len(Pairs([shard], RECIPE.network)) > 8


def test_a_drive_is_simulated_once_and_leaves_nothing_but_its_shard(drive, prepared, monkeypatch):
    options, shard = prepared
    assert [path.name for path in options.cache.iterdir() if not path.name.startswith(".")] == [
        drive_name(*drive, RECIPE)
    ]
    monkeypatch.setattr(simulated_data, "simulated_recording", lambda *_: pytest.fail("simulated again"))
    assert prepare_drives([drive], RECIPE, options)[0].folder == shard.folder


def test_what_determines_a_drive_determines_the_name_of_its_shard(drive, tmp_path):
    config, lidar = drive
    path = tmp_path / "poses.txt"
    names = []
    for row in ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 0 0 1 0 1 0 0 0 0 1 0\n"):
        path.write_text(row)
        names.append(drive_name(config.model_copy(update={"poses": path}), lidar, RECIPE))
    names += [
        drive_name(config, lidar, RECIPE),
        drive_name(config.model_copy(update={"seed": 8}), lidar, RECIPE),
        drive_name(config, replace(lidar, columns=90), RECIPE),
        drive_name(config, lidar, preset("default")),
    ]
    assert len(set(names)) == len(names)


def test_drives_cover_speeds_traffic_scenes_and_specimens_and_are_reproducible():
    drawn = [training_drive(seed, 22.0) for seed in range(200)]
    assert drawn == [training_drive(seed, 22.0) for seed in range(200)]
    configs, lidars = zip(*drawn, strict=True)
    assert min(c.speed_m_s for c in configs) < 4
    assert max(c.speed_m_s for c in configs) > 31
    assert min(c.traffic_per_km for c in configs) < 3
    assert max(c.traffic_per_km for c in configs) > 57
    assert {c.scene for c in configs} == {"town", "field", "corridor"}
    shifts = np.array([np.subtract(lidar.elevations_deg, LIDAR_MODELS["hdl-64e"].elevations_deg) for lidar in lidars])
    assert 0.1 < shifts.mean(axis=1).std() < 0.5
    assert all(np.all(np.diff(lidar.elevations_deg) <= 0) for lidar in lidars)


def test_training_and_validation_drives_are_apart(tmp_path, monkeypatch):
    seeds = []

    def keep_seeds(planned, *_):
        seeds.extend(config.seed for config, _ in planned)
        return seeds

    monkeypatch.setattr(simulated_data, "prepare_drives", keep_seeds)
    training, validation = simulated_drives(60, RECIPE, DataOptions(tmp_path))
    assert (len(training), len(validation)) == (60, 3)
    assert len(set(seeds)) == 63
