import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hybridlio.core import se3 as reference
from hybridlio.learned.networks import torch_se3 as se3

ANGLES = [0.0, 1e-9, 1e-5, 0.0099, 0.0101, 0.3, 2.0, 3.1, np.pi - 1e-7]


def tangents(angle: float, count: int = 8) -> np.ndarray:
    rng = np.random.default_rng(5)
    axes = rng.normal(size=(count, 3))
    return np.hstack([angle * axes / np.linalg.norm(axes, axis=1, keepdims=True), rng.normal(size=(count, 3)) * 5])


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_are_those_of_the_numpy_leaf(angle):
    xi = tangents(angle)
    T = se3.exp(torch.tensor(xi))
    assert np.allclose(T.numpy(), reference.exp(xi), atol=1e-12)
    assert np.allclose(se3.log(T).numpy(), reference.log(reference.exp(xi)), atol=2e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.0099, 0.0101, 1.0, 3.0])
def test_gradients_of_exp_log_and_their_round_trip_are_right_near_zero_too(angle):
    xi = torch.tensor(tangents(angle, 2), requires_grad=True)
    assert torch.autograd.gradcheck(se3.exp, (xi,), atol=1e-6)
    assert torch.autograd.gradcheck(lambda x: se3.log(se3.exp(x)), (xi,), atol=1e-5)


def test_a_pose_times_its_inverse_is_the_identity():
    T = se3.exp(torch.tensor(tangents(1.2)))
    assert torch.allclose(T @ se3.inverse(T), se3.identity(len(T), T), atol=1e-12)


def test_points_move_as_in_the_numpy_leaf():
    T, points = reference.exp(tangents(0.7)), np.random.default_rng(0).normal(size=(8, 50, 3))
    moved = se3.transform(torch.tensor(T), torch.tensor(points))
    assert np.allclose(moved.numpy(), reference.transform(T, points), atol=1e-12)


def test_euler_angles_are_roll_pitch_yaw_about_fixed_axes():
    angles = np.random.default_rng(1).uniform(-1.4, 1.4, size=(50, 3))
    R = se3.euler_to_rotation(torch.tensor(angles))
    assert np.allclose(R.numpy(), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-12)


def test_euler_angles_have_the_gradient_of_the_tangent_at_zero():
    zero = torch.zeros(3, dtype=torch.float64)
    by_euler = torch.autograd.functional.jacobian(se3.euler_to_rotation, zero)
    by_tangent = torch.autograd.functional.jacobian(se3.so3_exp, zero)
    assert torch.allclose(by_euler, by_tangent)


def test_single_precision_keeps_small_rotations():
    xi = torch.tensor(tangents(1e-4), dtype=torch.float32)
    assert torch.allclose(se3.log(se3.exp(xi)), xi, atol=1e-6, rtol=1e-5)
