"""Doubts about references: lengths against forward speed, and jumps; silence where a reference is good."""

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.reference_check import reference_doubts


def path(seconds: float = 60.0, rate_hz: float = 10.0, acceleration_m_s2: float = 15.0) -> Trajectory:
    """Return a path whose acceleration along x reaches a limit; 15 m/s² is a racing drone's."""
    times = np.arange(int(seconds * rate_hz)) / rate_hz
    positions = np.column_stack([5 * times + acceleration_m_s2 * np.sin(times), np.cos(times), 0 * times])
    return Trajectory((times * 1e9).astype(np.int64), se3.make(np.tile(np.eye(3), (len(times), 1, 1)), positions))


@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 100.0])
def test_violent_motion_is_no_doubt(rate_hz: float) -> None:
    assert reference_doubts(path(rate_hz=rate_hz)) == []


def test_noise_of_a_survey_grade_receiver_is_no_doubt() -> None:
    good = path()
    noise = np.random.default_rng(0).normal(0, 0.02, (len(good), 3))
    poses = good.poses.copy()
    poses[:, :3, 3] += noise
    assert reference_doubts(Trajectory(good.stamps_ns, poses)) == []


def test_jumps_are_counted() -> None:
    poses = path().poses.copy()
    poses[300:, 0, 3] += 3.0
    (doubt,) = reference_doubts(Trajectory(path().stamps_ns, poses))
    assert "jumps at 29.9 s and 1 times more" in doubt


@pytest.mark.parametrize(("length_m", "doubts"), [(100.0, 0), (100.5, 0), (99.5, 0), (97.0, 1), (103.0, 1)])
def test_lengths_that_differ_by_more_than_a_percent_are_a_doubt(length_m: float, doubts: int) -> None:
    assert len(reference_doubts(path(), length_m, 100.0)) == doubts


def test_a_vehicle_at_rest_has_no_length_to_compare() -> None:
    assert reference_doubts(path(), 3.0, 0.2) == []
