"""Scenarios by name."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.simulation.plan import plan
from hybridlio.simulation.scenarios import SCENARIOS, open_scenario, scenario_config


def largest(scenario: str, seed: int = 2302) -> tuple[float, float]:
    """Return the largest deceleration in m/s² and yaw rate in rad/s of a scenario's drive."""
    drive = plan(scenario_config(scenario, seed, 300.0))
    motion = drive.path.motion(np.arange(0.0, drive.scan_times_s[-1], 0.01))
    speed = np.linalg.norm(motion.velocity_m_s, axis=1)
    return float(-np.diff(speed).min() / 0.01), float(np.abs(motion.angular_velocity_rad_s[:, 2]).max())


def test_hard_driving_brakes_and_turns_harder_than_calm_driving():
    (calm_brake, calm_turn), (hard_brake, hard_turn) = largest("normal"), largest("hard-driving")
    assert calm_brake < 4 < 6 < hard_brake
    assert hard_turn > 0.8 > calm_turn


def test_every_scenario_has_valid_settings():
    for name, scenario in SCENARIOS.items():
        assert scenario.description
        assert scenario_config(name, 1, 100.0).seed == 1


def test_heavy_traffic_has_many_more_cars_on_the_same_road():
    calm, heavy = (plan(scenario_config(name, 2302, 150.0)) for name in ("normal", "heavy-traffic"))
    assert len(heavy.cars) > 3 * len(calm.cars)
    assert np.allclose(calm.path.poses(5.0), heavy.path.poses(5.0))


def test_faults_share_the_normal_drive_and_are_noted(tmp_path):
    normal = open_scenario("normal", tmp_path, seed=3, length_m=8.0)
    for name in ("dropped-scans", "blocked", "imu-gap", "imu-bias"):
        faulty = open_scenario(name, tmp_path, seed=3, length_m=8.0)
        assert "injected fault" in faulty.notes[-1]
        assert faulty.name == normal.name
    assert [folder.name for folder in tmp_path.iterdir()] == ["normal"]


def test_an_unknown_scenario_raises_an_error_that_lists_all(tmp_path):
    with pytest.raises(ConfigError, match="imu-gap"):
        open_scenario("earthquake", tmp_path)
