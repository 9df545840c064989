"""The shipped network, trained on 64 beams, takes other lidars by cells that fit them, or says why not."""

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Frame, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.record import plain_values

NETWORK = Config(initial_pose="preintegration", residual="network", backend="none")


@pytest.fixture(scope="module")
def sequence(tiny_drive):
    return open_sequence(tiny_drive)


def test_sixteen_beams_work_out_of_the_box_and_it_is_said(sequence, caplog):
    odometry = Odometry(config=NETWORK)
    estimates = [odometry.step(frame) for frame in sequence]
    assert "the maps get 16 x 720" in caplog.text
    assert all(estimate.relative.ok for estimate in estimates[1:])
    steps = np.array([estimate.relative.pose for estimate in estimates[2:]])
    true = se3.between(sequence.reference.poses[1:-1], sequence.reference.poses[2:])
    assert np.linalg.norm(se3.log(se3.between(true, steps))[:, 3:], axis=1).max() < 0.03


def test_a_stored_state_continues_on_the_cells_that_were_found(sequence):
    frames = list(sequence)[:8]
    whole = Odometry(config=NETWORK)
    estimates = [whole.step(frame) for frame in frames]
    first = Odometry(config=NETWORK)
    for frame in frames[:5]:
        first.step(frame)
    state = plain_values.decode(plain_values.encode(first.state()))
    resumed = Odometry(config=NETWORK)
    resumed.resume(zip(frames[:5], estimates[:5], strict=True), state)
    for frame, estimate in zip(frames[5:], estimates[5:], strict=True):
        assert np.array_equal(resumed.step(frame).pose, estimate.pose)


def test_weights_that_pool_their_cells_are_refused_on_another_lidar(sequence):
    config = NETWORK.model_copy(update={"network": NETWORK.network.__class__(weights="published", refine_steps=0)})
    odometry = Odometry(config=config)
    with pytest.raises(DataError, match=r"52 x 360.*weights trained for this lidar"):
        odometry.step(next(iter(sequence)))


def test_a_lidar_without_a_grid_of_beams_is_refused_with_what_to_do():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    scan = Scan(0, (10 * directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32))
    with pytest.raises(DataError, match="scan-matching"):
        Odometry(config=NETWORK).step(Frame(0, scan))
