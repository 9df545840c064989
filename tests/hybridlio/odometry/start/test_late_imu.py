"""An IMU that wakes up after the lidar: the first steps are as good as later ones, or say how far off they may be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walks import errors_of, walk

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry import measured_step
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record import plain_values
from hybridlio.simulation.platforms.config import PlatformConfig

WALK = PlatformConfig(scene="campus", platform="handheld", lidar="os0", seconds=2.0, seed=11)
FLIGHT = PlatformConfig(scene="campus", platform="drone", lidar="os0", seconds=2.0, seed=12)
COUNT = 6
_ALL = chi_square_quantile(0.9999, 3)


def in_memory(config: PlatformConfig) -> Sequence:
    recording = walk(config, count=COUNT)
    return replace(recording, load_scan=[frame.scan for frame in recording].__getitem__)


@pytest.fixture(scope="module")
def walked() -> Sequence:
    return in_memory(WALK)


@pytest.fixture(scope="module")
def flown() -> Sequence:
    return in_memory(FLIGHT)


def late(recording: Sequence, late_ms: int) -> Sequence:
    """Return the recording with samples from a time after the first scan on."""
    imu, kept = recording.imu, recording.imu.stamps_ns >= recording.stamps_ns[0] + late_ms * 1_000_000
    return replace(recording, imu=ImuSamples(imu.stamps_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept]))


def estimates_of(recording: Sequence) -> list[Estimate]:
    odometry = Odometry()
    return [odometry.step(frame) for frame in recording]


def normalised(estimates: list[Estimate], recording: Sequence) -> Array:
    """Return the squared errors ``(N, 2)`` of rotation and position, by their covariances."""
    errors = errors_of(estimates, recording.reference)[1:]
    parts = slice(0, 3), slice(3, 6)
    return np.array(
        [
            [e[p] @ np.linalg.solve(one.covariance[p, p], e[p]) for p in parts]
            for e, one in zip(errors, estimates[1:], strict=True)
        ]
    )


@pytest.mark.parametrize("late_ms", [10, 100, 250])
def test_poses_on_foot_are_within_their_covariances_whenever_samples_start(walked: Sequence, late_ms: int) -> None:
    recording = late(walked, late_ms)
    estimates = estimates_of(recording)
    squared = normalised(estimates, recording)
    assert squared.max() < _ALL
    errors = np.array(errors_of(estimates, recording.reference))
    assert np.linalg.norm(errors[-1, 3:]) < 0.05
    assert np.degrees(np.linalg.norm(errors[-1, :3])) < 0.3


def test_and_on_a_drone(flown: Sequence) -> None:
    recording = late(flown, 50)
    assert normalised(estimates_of(recording), recording).max() < _ALL


def test_without_placing_the_first_scan_anew_it_would_be_degrees_off(
    walked: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = late(walked, 100)

    def turn_deg() -> float:
        errors = np.array(errors_of(estimates_of(recording), recording.reference))
        return float(np.degrees(np.linalg.norm(errors[1:, :3], axis=1).min()))

    placed = turn_deg()
    monkeypatch.setattr(measured_step, "_placed", lambda *_: None)
    assert turn_deg() > 2 * placed


def test_a_run_that_goes_on_gives_the_same_poses(walked: Sequence) -> None:
    frames, done = list(late(walked, 250)), 2
    whole, first, second = Odometry(), Odometry(), Odometry()
    expected = [whole.step(frame) for frame in frames]
    kept = [first.step(frame) for frame in frames[:done]]
    state = first.state()
    assert state is not None
    bare = [replace(frame, scan=Scan(frame.scan.stamp_ns, np.empty((0, 3), np.float32))) for frame in frames[:done]]
    second.resume(zip(bare, kept, strict=True), plain_values.decode(plain_values.encode(state)))
    for frame, one in zip(frames[done:], expected[done:], strict=True):
        np.testing.assert_allclose(second.step(frame).pose, one.pose, atol=1e-9)
