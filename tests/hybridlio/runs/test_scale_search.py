"""The IMU's scale over the rounds of a calibration, and the file that it is written to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import handheld
import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import Calibration
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.sequence import Sequence
from hybridlio.runs.scale_search import ScaleSearch
from hybridlio.smoothing.calibration import Calibrated, Parameter, undetermined_elements

WRONG = ImuScale(np.eye(3) + 0.01 * np.array([[1.5, 0, 0.5], [0, -1.5, 0], [0, 0.5, 1]]))


@pytest.fixture(scope="module")
def walk() -> handheld.Handheld:
    return handheld.carried(np.random.default_rng(2), seconds=25.0)


@pytest.fixture
def sequence(walk: handheld.Handheld) -> Sequence:
    return handheld.as_sequence(np.random.default_rng(2), walk, WRONG.corrected(walk.imu))


def test_rounds_settle_and_are_written_as_the_scale_of_the_raw_samples(
    walk: handheld.Handheld, sequence: Sequence, tmp_path: Path
):
    search, stated = ScaleSearch(), ImuScale(np.diag([1.01, 1.0, 1.0]))
    assert not search.is_settled
    for _ in range(2):
        sequence = replace(sequence, imu=search.correct(walk.path, sequence))
    assert search.is_settled
    found = search.added_to(Calibrated(Calibration(handheld.MOUNTING), 0.0, 0.0, ()), stated)
    np.testing.assert_allclose(found.imu_scale.gyro, np.linalg.inv(WRONG.gyro) @ stated.gyro, atol=3e-3)
    found.save(tmp_path / "calibration.yaml")
    read = read_calibration_yaml(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(read.imu_scale.gyro, found.imu_scale.gyro)
    assert "gyro_scale_ratio" in (tmp_path / "calibration.yaml").read_text()
    assert "% across axes" in str(found.parameter("gyro_scale"))


def test_a_recording_that_is_too_short_is_named(walk: handheld.Handheld, sequence: Sequence):
    path = walk.path
    short = type(path)(path.stamps_ns[:50], path.poses[:50])
    with pytest.raises(DataError, match="walk: too short to find the IMU's scale"):
        ScaleSearch().correct(short, sequence)


def test_elements_that_the_motion_hardly_shows_are_named():
    covariance = np.diag(np.r_[1e-4, np.full(8, 1e-8)])
    undetermined = undetermined_elements(covariance, np.full(9, 0.01))
    found = Parameter("gyro_scale", np.zeros(9), covariance, 0.01, undetermined)
    assert found.doubt == "gyro_scale: the motion hardly shows xx; known little better than from a data sheet"
