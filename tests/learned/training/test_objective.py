from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.core import se3
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.networks.network_types import NetworkOutput
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.settings import LossSettings
from hybridlio.learned.training.objective import clouds_for, descended, objective
from hybridlio.learned.training.validation import step_errors

L1 = LossSettings(kernel_m=0.03, reduction="mean", max_distance_m=1.0)


@pytest.fixture
def pairs(rooms, tiny_recipe):
    """Eight pairs of scans of a room, with the inputs of the tiny recipe's network."""
    return Pairs(rooms[:1], tiny_recipe.network).batch(range(8))


def off(batch, xi):
    return batch.reference @ torch.tensor(se3.exp(xi), dtype=torch.float32)


def test_gauss_newton_steps_down_the_loss_lead_to_the_truth(pairs, tiny_recipe):
    start = off(pairs, [0.01, -0.005, 0.01, 0.05, -0.04, 0.03])
    clouds = clouds_for(pairs, L1)
    errors = []
    for count in (0, 2, 6):
        settings = replace(L1, target_steps=count)
        found = descended(start, clouds, settings, tiny_recipe.network.geometry).double().numpy()
        errors.append(step_errors(found, pairs.reference.double().numpy())[1])
    assert errors[0] > 2 * errors[1]
    assert errors[1] > errors[2]
    assert errors[2] < 0.02


def test_the_loss_of_one_pose_does_not_depend_on_where_matches_are_searched(pairs, tiny_recipe):
    pose = off(pairs, [0.0, 0.0, 0.01, 0.05, 0.0, 0.0])
    output = NetworkOutput(pose, (pose,))
    each, answer = (
        objective(output, pairs, replace(L1, matched_at=how), tiny_recipe.network.geometry)
        for how in ("each", "answer")
    )
    assert torch.allclose(each.total, answer.total)
    with_initial = objective(output, pairs, replace(L1, initial_weight=0.5), tiny_recipe.network.geometry)
    assert torch.allclose(with_initial.total, 1.5 * each.total)


def test_a_target_adds_the_distance_to_the_pose_after_descent(pairs, tiny_recipe):
    pose = off(pairs, [0.0, 0.0, 0.0, 0.05, 0.0, 0.0])
    settings, geometry = replace(L1, target_weight=1.0), tiny_recipe.network.geometry
    target = descended(pose, clouds_for(pairs, L1), settings, geometry)
    xi = se3.log(se3.between(target.double().numpy(), pose.double().numpy()))
    apart = np.sqrt((xi[:, 3:] ** 2).sum(1) + (10 * xi[:, :3]) ** 2 @ np.ones(3))
    output = NetworkOutput(pose, (pose,))
    more = objective(output, pairs, settings, geometry).total - objective(output, pairs, L1, geometry).total
    assert more.numpy() == pytest.approx(apart, abs=2e-4)


def test_behind_registration_steps_the_lstms_learn_from_their_own_initial_pose_alone(pairs, tiny_recipe):
    torch.manual_seed(0)
    network = OdometryNetwork(replace(tiny_recipe.network, projective_steps=2, encoder=False))
    for weight in (0.0, 0.1):
        network.zero_grad()
        settings = replace(L1, initial_weight=weight)
        objective(network(pairs.network), pairs, settings, tiny_recipe.network.geometry).total.sum().backward()
        gradient = network.imu_network.translation.weight.grad
        assert (gradient is not None and bool(gradient.abs().max() > 0)) == bool(weight)
