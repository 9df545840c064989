from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import handheld
import numpy as np
import pytest

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.sequence import Sequence
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.config import Config
from hybridlio.runs.calibrate import _Search
from hybridlio.smoothing.calibration import OF_IMU, Calibrated, CalibrationPriors, Parameter

OFFSET_S = 0.03  # to add to the samples' stamps


@pytest.fixture(scope="module")
def wrong() -> Sequence:
    """A walk through a room whose mounting is stated 3° and 6 cm off, and whose IMU is 30 ms early."""
    rng = np.random.default_rng(3)
    walk = handheld.carried(rng, seconds=10.5)
    imu = ImuSamples(walk.imu.stamps_ns - round(OFFSET_S * 1e9), walk.imu.gyro_rad_s, walk.imu.accel_m_s2)
    true = handheld.MOUNTING
    turn = se3.so3_exp(np.deg2rad([2.0, -1.5, 1.5]))
    stated = se3.make(true[:3, :3] @ turn, true[:3, 3] + [0.03, -0.05, 0.02])
    return handheld.as_sequence(rng, walk, imu, stated)


@pytest.fixture(scope="module")
def searched(wrong: Sequence) -> tuple[Calibrated, list[str], int]:
    """The calibration that is found, the log where every round warns, and the number of rounds."""
    shown, rounds, log = list[str](), list[int](), logging.getLogger("hybridlio")

    def smooth_with_warning(*arguments: Any, **options: Any) -> Any:
        rounds.append(len(rounds))
        logging.getLogger("hybridlio.graph.run.smooth").warning("of round %d", len(rounds))
        return smooth(*arguments, **options)

    handler = logging.Handler()
    handler.emit = lambda record: shown.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hybridlio.runs.calibrate.smooth", smooth_with_warning)
        found = hl.calibrate(wrong)
    log.removeHandler(handler)
    return found, shown, len(rounds)


@pytest.fixture(scope="module")
def found(searched: tuple[Calibrated, list[str], int]) -> Calibrated:
    return searched[0]


def test_a_walk_through_a_room_gives_the_mounting_and_the_clock(found: Calibrated):
    error = se3.between(handheld.MOUNTING, found.calibration.T_imu_lidar)
    assert np.linalg.norm(se3.so3_log(error[:3, :3])) < np.deg2rad(0.3)
    assert np.linalg.norm(found.calibration.T_imu_lidar[:3, 3] - handheld.MOUNTING[:3, 3]) < 0.02
    assert abs(found.imu_time_offset_s - OFFSET_S) < 1e-3


def test_the_changes_are_those_from_the_stated_calibration(found: Calibrated, wrong: Sequence):
    T = wrong.calibration.T_imu_lidar @ se3.make(se3.so3_exp(found.parameter("rotation").change), np.zeros(3))
    np.testing.assert_allclose(T[:3, :3], found.calibration.T_imu_lidar[:3, :3], atol=1e-9)
    assert found.parameter("time_offset").change[0] == pytest.approx(found.imu_time_offset_s)


def test_the_written_file_is_read_back_with_the_recordings_other_keys(found: Calibrated, tmp_path: Path):
    found.save(tmp_path / "calibration.yaml", {"lidar": "16-beam", "frames": [], "imu_time_offset_s": 5.0})
    stated = read_calibration_yaml(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(stated.calibration.T_imu_lidar, found.calibration.T_imu_lidar)
    assert stated.imu_time_offset_s == pytest.approx(found.imu_time_offset_s)
    assert stated.lidar is not None
    assert "rotation_rad" in (tmp_path / "calibration.yaml").read_text()


def test_a_recording_without_what_is_needed_is_refused(wrong: Sequence):
    with pytest.raises(DataError, match="calibration needs 100 or more"):
        hl.calibrate(wrong.part(0, 50))
    with pytest.raises(ConfigError, match="time_offset needs IMU samples"):
        hl.calibrate(dataclasses.replace(wrong, imu=ImuSamples.empty()))
    with pytest.raises(ConfigError, match="lever_arm needs GPS fixes"):
        hl.calibrate(wrong, ("lever_arm",))


def test_warnings_of_rounds_before_the_last_are_not_shown(searched: tuple[Calibrated, list[str], int]):
    """They concern a calibration that the next round replaced."""
    _, shown, rounds = searched
    assert rounds > 2
    assert [text for text in shown if text.startswith("of round")] == [f"of round {rounds}"]


@pytest.mark.parametrize("share", [0.15, 0.4, 1.0])
def test_a_round_that_shows_a_share_of_the_clocks_error_is_divided_by_it(wrong: Sequence, share: float):
    """Compensation by a wrong clock hides a part of its error; the rounds' slope shows which."""
    search, true_s, sigma_s = _Search(wrong, CalibrationPriors(OF_IMU), Config(), lambda *_: None), 0.003, 1e-4
    found = Parameter("time_offset", np.zeros(1), np.array([[sigma_s**2]]), 0.1, np.empty((0, 1)))
    for beside_s in (0.0, 0.0, 5e-3):  # two rounds near one another, and one beside the clock that they mean
        search._take_clock(share * (true_s - search._offset_s), sigma_s)
        search._move(beside_s)
    assert search._take_clock(share * (true_s - search._offset_s), sigma_s)
    assert search._share == pytest.approx(share, rel=0.01)
    assert search._offset_s == pytest.approx(true_s, abs=1e-8)
    assert search._widened(found).sigmas[0] == pytest.approx(sigma_s / share, rel=0.01)
    search._variance_factor = 0.3**2  # of residuals that show the same share; at most as stated
    stated = 1 / max(share, 0.3)
    assert search._widened(found).sigmas[0] == pytest.approx(sigma_s / share * stated, rel=0.01)


def test_the_scale_alone_is_found_without_a_graph():
    """25 s of a walk: what is left of 1.5 % is a tenth, and the extrinsics stay as stated."""
    rng = np.random.default_rng(5)
    walk = handheld.carried(rng, seconds=25.0)
    scale = ImuScale(np.diag([1.015, 0.985, 1.015]))
    sequence = handheld.as_sequence(rng, walk, scale.corrected(walk.imu))
    found = hl.calibrate(sequence, ("imu_scale",))
    assert np.abs(found.imu_scale.gyro - np.linalg.inv(scale.gyro)).max() < 4e-3
    np.testing.assert_array_equal(found.calibration.T_imu_lidar, handheld.MOUNTING)
    assert [one.name for one in found.parameters] == ["gyro_scale", "accel_scale"]
