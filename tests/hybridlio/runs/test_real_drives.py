"""The odometry on real recordings."""

import numpy as np
import pytest

from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import run_odometry
from hybridlio.runs.write import forward_speed_length_m


def test_a_standing_car_has_a_constant_pose(kitti_raw_root):
    run = run_odometry(open_sequence(kitti_raw_root, sequence="0060"), Odometry())
    assert run.stopped is None
    assert run.done == 20
    assert run.ok.all()
    assert np.linalg.norm(run.trajectory.poses[-1, :3, 3]) < 0.02
    assert run.trajectory.length_m < 0.05


def test_the_path_length_of_a_driving_car_agrees_with_its_forward_speed(kitti_raw_root):
    run = run_odometry(open_sequence(kitti_raw_root, sequence="0048"), Odometry())
    assert run.stopped is None
    assert run.ok.all()
    assert run.trajectory.length_m == pytest.approx(forward_speed_length_m(run), rel=0.01)
