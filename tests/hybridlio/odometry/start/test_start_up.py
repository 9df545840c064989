"""Start-up with an IMU whose samples start after the scans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Frame, ImuSamples
from hybridlio.datasets.registry import open_sequence
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.chain import Chain, ChainSettings, make_chain

LATE = 15


class Given:
    """A residual source that returns the chain's relative poses."""

    name = "given"

    def __init__(self, relative: list[RelativePose]) -> None:
        self._relative = relative

    def start(self, frame: Frame) -> None:
        """Do nothing."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        return self._relative[frame.index - 1]


def late(frames: list[Frame], first: int = LATE) -> list[Frame]:
    """Return the frames without samples up to scan ``first`` and for half of the step after it."""
    out = [replace(frame, imu=ImuSamples.empty()) if frame.index <= first else frame for frame in frames]
    middle = (frames[first].scan.stamp_ns + frames[first + 1].scan.stamp_ns) // 2
    out[first + 1] = replace(out[first + 1], imu=out[first + 1].imu.between(middle, frames[first + 1].scan.stamp_ns))
    return out


def driven(drive: Chain, frames: list[Frame], backend: str) -> tuple[Odometry, list[State]]:
    odometry, states = Odometry(residual=Given(drive.relative), backend=backend), []
    for frame in frames:
        odometry.step(frame)
        if odometry._pipeline.state is not None:
            states.append(odometry._pipeline.state)
    return odometry, states


@pytest.fixture(scope="module", params=[None, 0.1], ids=["steps", "map"])
def drive(request: pytest.FixtureRequest) -> Chain:
    return make_chain(5, ChainSettings(steps=45, drift_share=request.param))


@pytest.mark.parametrize("backend", ["incremental", "fixed-lag"])
def test_gravity_speed_and_biases_are_estimated_once_samples_come(drive: Chain, backend: str):
    _, states = driven(drive, late(drive.frames), backend)
    assert [state.has_imu for state in states] == [k > LATE for k in range(1, len(drive.frames))]
    end, (whole, *_) = states[-1], driven(drive, drive.frames, backend)[1][::-1]
    for found, truth, sigma in (
        (end.velocity_m_s, drive.velocities[-1], end.covariance[6:9, 6:9]),
        (end.gyro_bias_rad_s, drive.gyro_biases[-1], end.covariance[12:, 12:]),
        (end.gravity_m_s2, drive.gravity, end.gravity_covariance),
    ):
        off = found - truth
        assert off @ np.linalg.solve(sigma, off) < 16.0  # χ² of three, 0.999
    assert np.linalg.norm(end.velocity_m_s - drive.velocities[-1]) < 0.3
    # the speed is known as well as with samples from the start, the pose only as well as from the steps
    assert np.sqrt(np.trace(end.covariance[6:9, 6:9])) < 2 * np.sqrt(np.trace(whole.covariance[6:9, 6:9]))
    assert np.trace(end.covariance[:3, :3]) > np.trace(whole.covariance[:3, :3])


@pytest.mark.parametrize("backend", ["incremental", "fixed-lag", "none"])
def test_taking_up_a_late_imu_keeps_poses_within_their_covariances(drive: Chain, backend: str):
    odometry, states = driven(drive, late(drive.frames), backend)
    without = driven(drive, [replace(f, imu=ImuSamples.empty()) for f in drive.frames], backend)[1]
    np.testing.assert_allclose(states[LATE - 1].T_world_imu, without[LATE - 1].T_world_imu, atol=1e-6)
    error = se3.log(se3.between(states[-1].T_world_imu, drive.poses[-1]))
    assert error @ np.linalg.solve(states[-1].covariance[:6, :6], error) < 22.5  # χ² of six, 0.999
    assert len(odometry.record().relative) == len(drive.relative)


def test_smoothing_uses_samples_that_start_late(drive: Chain):
    odometry, _ = driven(drive, late(drive.frames), "fixed-lag")
    record = odometry.record()
    assert record.start.has_imu
    assert int(record.imu.stamps_ns[0]) > drive.frames[LATE].scan.stamp_ns
    ends = [smooth(r).trajectory for r in (record, replace(record, imu=ImuSamples.empty()))]
    tilt = [np.trace(end.covariances[-1][:2, :2]) for end in ends if end.covariances is not None]
    assert tilt[0] < tilt[1]


def test_a_drive_whose_imu_starts_late_is_followed_with_a_warning(tiny_drive: Path, caplog: pytest.LogCaptureFixture):
    sequence = open_sequence(tiny_drive)
    odometry = Odometry()
    poses = np.array([odometry.step(frame).pose for frame in late(list(sequence), 10)])
    assert sequence.reference is not None
    errors = se3.log(se3.between(poses, sequence.reference.poses))
    assert np.linalg.norm(errors[:, 3:5], axis=1).max() < 0.1
    assert [m for r in caplog.records if "IMU samples start here" in (m := r.getMessage())] == [
        "frame 11: IMU samples start here; the scans before had none"
    ]
