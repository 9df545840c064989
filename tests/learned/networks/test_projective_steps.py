from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core import se3
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.networks import maps
from hybridlio.learned.networks.projective_steps import ProjectiveSteps, weighted_step
from hybridlio.learned.training.run_options import RunOptions
from hybridlio.learned.training.train import train
from hybridlio.learned.training.validation import step_errors

GEOMETRY = MapGeometry(20.0, -20.0, 40, 180)
STEP = se3.exp([0.004, -0.003, 0.01, 0.15, -0.1, 0.05])


def room_maps(T_world_lidar: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps of a box of 16 x 12 x 4 m, seen along the middles of the cells."""
    elevation = np.radians(GEOMETRY.fov_up_deg - (np.arange(40) + 0.5) * GEOMETRY.row_deg)[:, None]
    azimuth = np.radians(180 - (np.arange(180) + 0.5) * GEOMETRY.column_deg)[None]
    parts = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    rays = np.stack(parts, axis=-1)
    turned = rays @ T_world_lidar[:3, :3].T
    ranges = ((np.array([8.0, 6.0, 2.0]) * np.sign(turned) - T_world_lidar[:3, 3]) / turned).min(axis=-1)
    vertices = torch.tensor(np.moveaxis(rays * ranges[..., None], -1, 0)[None], dtype=torch.float32)
    return vertices, maps.normal_map(vertices)


def steps(recipe, count, **changes):
    network = replace(recipe.network, geometry=GEOMETRY, projective_steps=count, **changes)
    torch.manual_seed(0)
    return ProjectiveSteps(network)


def test_steps_between_the_maps_find_the_pose_without_any_training(tiny_recipe):
    net = steps(tiny_recipe, 4)
    poses = net(net.encode(*room_maps(np.eye(4))), net.encode(*room_maps(STEP)), torch.eye(4)[None])
    assert len(poses) == 4
    rotation_deg, translation_m = step_errors(poses[-1].detach().double().numpy(), STEP[None])
    assert rotation_deg < 0.05
    assert translation_m < 0.01


def test_untrained_weights_leave_the_kernel_alone(tiny_recipe):
    nets = steps(tiny_recipe, 2), steps(tiny_recipe, 2, weight_channels=0)
    at = torch.eye(4)[None]
    found = [net(net.encode(*room_maps(np.eye(4))), net.encode(*room_maps(STEP)), at)[-1] for net in nets]
    assert torch.allclose(*found, atol=1e-5)


def test_weights_follow_the_points_and_not_their_order_in_the_batch(tiny_recipe):
    net = steps(tiny_recipe, 2)
    torch.nn.init.normal_(net.weights.logit.weight)
    one, other, at = room_maps(np.eye(4)), room_maps(STEP), torch.eye(4)[None]
    last, current = (tuple(map(torch.cat, zip(*pair, strict=True))) for pair in ((one, other), (other, one)))
    both = net(net.encode(*last), net.encode(*current), at.expand(2, 4, 4))[-1]
    assert torch.allclose(both[:1], net(net.encode(*one), net.encode(*other), at)[-1], atol=1e-5)
    assert torch.allclose(both[1:], net(net.encode(*other), net.encode(*one), at)[-1], atol=1e-5)
    fresh = steps(tiny_recipe, 2)
    assert not torch.allclose(both[:1], fresh(fresh.encode(*one), fresh.encode(*other), at)[-1], atol=1e-5)


def test_one_step_solves_a_small_motion_of_planes():
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(1, 3, 600, generator=generator), dim=1)
    points = 10 * torch.randn(1, 3, 600, generator=generator)
    moved_back = torch.tensor(se3.exp([1e-4, -2e-4, 3e-4, 0.01, -0.02, 0.03]), dtype=torch.float32)
    shown = moved_back[:3, :3] @ points + moved_back[:3, 3:]
    distance = (normals * (shown - points)).sum(1, keepdim=True)
    found = weighted_step(normals, shown, distance, torch.ones_like(distance))
    assert torch.allclose(found[0] @ moved_back, torch.eye(4), atol=2e-4)


def test_points_of_zero_weight_do_not_change_the_step():
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(1, 3, 600, generator=generator), dim=1)
    points, distance = 10 * torch.randn(1, 3, 600, generator=generator), torch.zeros(1, 1, 600)
    distance[..., :300] = 0.5
    weights = torch.ones_like(distance)
    weights[..., :300] = 0.0
    assert torch.allclose(weighted_step(normals, points, distance, weights), torch.eye(4)[None], atol=1e-6)
    assert weighted_step(normals, points, distance, torch.zeros_like(distance)).isfinite().all()


def test_along_a_corridor_no_step_is_taken():
    generator = torch.Generator().manual_seed(0)
    points = 10 * torch.randn(1, 3, 600, generator=generator)
    normals = torch.zeros_like(points)
    normals[:, 1], normals[:, 2, ::2] = 0.6, 0.8
    normals[:, 1, 1::2] = 1.0
    distance = (normals * torch.tensor([0.5, -0.02, 0.03])[:, None]).sum(1, keepdim=True)
    found = weighted_step(normals, points, distance, torch.ones_like(distance))[0, :3, 3]
    assert found.tolist() == pytest.approx([0.0, 0.02, -0.03], abs=1e-3)


def test_training_moves_the_weights_and_keeps_what_the_step_finds(rooms, tiny_recipe, tmp_path):
    network = replace(tiny_recipe.network, imu="given", projective_steps=2, residual_scale=1e-3)
    optimiser = replace(tiny_recipe.optimiser, initial_noise_rad=0.005, initial_noise_m=0.1, epochs=2)
    recipe = replace(tiny_recipe, network=network, optimiser=optimiser)
    trained = train(recipe, Pairs(rooms[:1], network), tmp_path, options=RunOptions(device="cpu"))
    assert trained.projective.weights.logit.weight.abs().max() > 0
