from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.errors import ConfigError
from hybridlio.learned.losses import correspondences
from hybridlio.learned.losses import loss as losses
from hybridlio.learned.losses.correspondences import Clouds, Matches, match, match_nearest, match_same_pixel, nearest
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.settings import LossSettings

GEOMETRY = MapGeometry(15.0, -25.0, 20, 90)


def room(count: int = 400, seed: int = 0, batch: int = 1) -> Clouds:
    """Points on three walls of a room that meet in (5, 5, -2), with the walls' normals."""
    generator = torch.Generator().manual_seed(seed)
    wall = torch.randint(3, (batch, count), generator=generator)
    points = torch.rand(batch, count, 3, generator=generator, dtype=torch.float64) * 8 - 4
    axes = torch.nn.functional.one_hot(wall, 3).to(points)
    corner = torch.tensor([5.0, 5.0, -2.0], dtype=torch.float64)
    points = torch.where(axes > 0, corner, points)
    return Clouds(points, -axes * corner.sign(), torch.ones(batch, count, dtype=torch.bool))


def pose(*xi: float, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return se3.exp(torch.tensor([xi], dtype=dtype))


def seen_from(T: torch.Tensor, cloud: Clouds) -> Clouds:
    inverse = se3.inverse(T)
    return Clouds(se3.transform(inverse, cloud.points), se3.rotate(inverse, cloud.normals), cloud.there)


def paired(T: torch.Tensor, cloud: Clouds) -> Matches:
    """Every point with itself, as seen from T."""
    current = seen_from(T, cloud)
    weight = torch.ones(cloud.points.shape[:2], dtype=torch.float64)
    return Matches(current.points, current.normals, cloud.points, cloud.normals, weight, cloud.there.sum(1))


SHIFT = (0.0, 0.0, 0.0, 0.1, -0.2, 0.3)
TURNED = (0.02, -0.03, 0.1, 0.4, 0.1, -0.2)


def test_the_loss_vanishes_at_the_true_pose_and_nowhere_near():
    T = pose(*TURNED)
    at = losses.loss(paired(T, room()), T, LossSettings())
    off = losses.loss(paired(T, room()), pose(*SHIFT), LossSettings())
    assert at.total.item() == pytest.approx(0.0, abs=1e-9)
    assert off.total.item() > 1.0


def test_a_shift_costs_its_part_along_each_points_normal():
    cloud = room()
    value = losses.loss(paired(pose(0, 0, 0, 0, 0, 0), cloud), pose(*SHIFT), LossSettings())
    on_wall = (cloud.normals != 0).sum(1)[0]
    expected = (on_wall * torch.tensor([0.1, 0.2, 0.3])).sum().item()
    assert value.total.item() == pytest.approx(expected)
    assert value.po2pl_m.item() == pytest.approx(expected / 400)


def test_a_rotation_costs_the_squared_chord_between_normals():
    angle = 0.2
    cloud = room()
    settings = LossSettings(alpha=0.0, lambda_=1.0)
    value = losses.loss(paired(pose(0, 0, 0, 0, 0, 0), cloud), pose(0, 0, angle, 0, 0, 0), settings)
    turned = (cloud.normals[0, :, :2] != 0).any(1).sum().item()  # normals along the axis stay
    assert value.total.item() == pytest.approx(turned * (2 * np.sin(angle / 2)) ** 2)


def test_element_by_element_a_slanted_plane_costs_more_than_its_distance():
    n = torch.tensor([[[0.6, 0.8, 0.0]]], dtype=torch.float64)
    zero, one = torch.zeros_like(n), torch.ones(1, 1, dtype=torch.float64)
    matches = Matches(zero, n, zero, n, one, torch.ones(1))
    T = pose(0, 0, 0, 0.8, -0.6, 0)  # along the plane
    assert losses.loss(matches, T, LossSettings()).total.item() == pytest.approx(0.0)
    by_element = losses.loss(matches, T, LossSettings(product="element-wise"))
    assert by_element.total.item() == pytest.approx(0.48 + 0.48)


def test_both_terms_are_weighed_and_the_mean_is_the_sum_by_count():
    matches, T = paired(pose(*TURNED), room()), pose(*SHIFT)
    parts = [losses.loss(matches, T, LossSettings(alpha=a, lambda_=b)).total for a, b in ((1, 0), (0, 1))]
    whole = losses.loss(matches, T, LossSettings(alpha=2.0, lambda_=0.1)).total
    assert torch.allclose(whole, 2 * parts[0] + 0.1 * parts[1])
    mean = losses.loss(matches, T, LossSettings(alpha=2.0, lambda_=0.1, reduction="mean")).total
    assert torch.allclose(mean, whole / 400)


def test_robust_kernels_are_quadratic_near_zero_and_have_their_known_limits():
    n = torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)
    zero, one = torch.zeros_like(n), torch.ones(1, 1, dtype=torch.float64)
    matches = Matches(zero, n, zero, n, one, torch.ones(1))

    def cost(kernel: str, distance: float) -> float:
        settings = LossSettings(kernel=kernel, kernel_m=0.1, lambda_=0.0)
        return losses.loss(matches, pose(0, 0, 0, distance, 0, 0), settings).total.item()

    assert cost("huber", 0.01) == pytest.approx(0.01**2 / 0.2)
    assert cost("huber", 3.0) == pytest.approx(3.0 - 0.05)
    assert cost("geman-mcclure", 0.1) == pytest.approx(0.05)
    assert cost("geman-mcclure", 1e4) == pytest.approx(0.1)


KINDS = [
    LossSettings(),
    LossSettings(product="element-wise"),
    LossSettings(kernel="huber"),
    LossSettings(kernel="geman-mcclure", lambda_=0.5),
]


@pytest.mark.parametrize("settings", KINDS, ids=lambda s: f"{s.kernel} {s.product}")
def test_the_gradient_is_that_of_finite_differences(settings):
    matches = paired(pose(*TURNED), room(40))
    xi = torch.tensor([[0.01, 0.02, -0.01, 0.3, -0.2, 0.15]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: losses.loss(matches, se3.exp(x), settings).total, (xi,), eps=1e-7)


@pytest.mark.parametrize("settings", KINDS[2:], ids=lambda s: s.kernel)
def test_gauss_newtons_gradient_is_the_losses_for_a_right_perturbation(settings):
    matches, T = paired(pose(*TURNED), room(60)), pose(*SHIFT)
    xi = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    losses.loss(matches, T @ se3.exp(xi), settings).total.sum().backward()
    assert torch.allclose(losses.gauss_newton(matches, T, settings).gradient, xi.grad)


@pytest.mark.parametrize("settings", [*KINDS[2:], replace(KINDS[2], product="element-wise")], ids=str)
def test_gauss_newtons_hessian_is_the_losses_where_residuals_vanish(settings):
    T = pose(*TURNED)
    matches = paired(T, room(60))

    def at(xi: torch.Tensor) -> torch.Tensor:
        return losses.loss(matches, T @ se3.exp(xi[None]), settings).total.sum()

    exact = torch.autograd.functional.hessian(at, torch.zeros(6, dtype=torch.float64))
    assert torch.allclose(losses.gauss_newton(matches, T, settings).hessian[0], exact, atol=1e-6, rtol=1e-6)


def test_the_information_counts_points_whatever_the_kernels_scale():
    T = pose(*TURNED)
    for kernel, kernel_m in (("huber", 0.1), ("huber", 0.4), ("geman-mcclure", 0.3)):
        settings = LossSettings(kernel=kernel, kernel_m=kernel_m, lambda_=0.0)
        found = losses.gauss_newton(paired(T, room()), T, settings)
        assert found.information[0, 3:, 3:].trace().item() == pytest.approx(400)


def test_a_corridor_does_not_constrain_motion_along_it():
    cloud = room()
    along_x = cloud.normals[..., 0] == 0
    cloud = Clouds(cloud.points, cloud.normals, along_x)
    identity = pose(0, 0, 0, 0, 0, 0)
    found = losses.gauss_newton(match_nearest(identity, cloud, cloud), identity, LossSettings(kernel="huber"))
    assert found.hessian[0, 3].abs().max().item() < 1e-9
    assert found.hessian[0, 4, 4].item() > 1.0


def test_trees_and_all_distances_find_the_same_neighbours_of_a_batch(monkeypatch):
    monkeypatch.setattr(correspondences, "_CHUNK", 5000)
    generator = torch.Generator().manual_seed(1)
    queries, targets = torch.randn(3, 300, 3, generator=generator), torch.randn(3, 200, 3, generator=generator)
    there = torch.rand(3, 200, generator=generator) > 0.3
    index, distance = nearest(queries, targets, there)
    by_distances = correspondences._by_distances(queries, targets, there)
    assert torch.equal(index, by_distances[0])
    assert torch.allclose(distance, by_distances[1], atol=1e-6)
    assert there.gather(1, index).all()


def test_a_limit_changes_nothing_but_neighbours_beyond_it():
    generator = torch.Generator().manual_seed(2)
    queries, targets = (torch.randn(1, n, 3, generator=generator) for n in (300, 200))
    there = torch.rand(1, 200, generator=generator) > 0.3
    index, distance = nearest(queries, targets, there)
    limited_index, limited = nearest(queries, targets, there, 0.5)
    near = distance < 0.5
    assert 0 < near.sum() < 300
    assert torch.equal(limited[near], distance[near])
    assert torch.equal(limited_index[near], index[near])
    assert torch.isinf(limited[~near]).all()
    assert ((limited_index >= 0) & (limited_index < 200)).all()


def test_without_targets_nothing_is_near():
    _, distance = nearest(torch.zeros(1, 4, 3), torch.zeros(1, 5, 3), torch.zeros(1, 5, dtype=torch.bool))
    assert torch.isinf(distance).all()


def test_padding_and_points_without_normals_have_zero_weight():
    cloud = room()
    T = pose(*SHIFT)
    whole = losses.loss(match_nearest(T, cloud, cloud), T, LossSettings())
    more = Clouds(
        torch.cat([cloud.points, torch.full((1, 50, 3), 5.0, dtype=torch.float64)], 1),
        torch.cat([cloud.normals, torch.zeros(1, 50, 3, dtype=torch.float64)], 1),
        torch.cat([cloud.there, torch.zeros(1, 50, dtype=torch.bool)], 1),
    )
    padded = losses.loss(match_nearest(T, more, more), T, LossSettings())
    assert torch.allclose(whole.total, padded.total)
    bare = Clouds(cloud.points, torch.zeros_like(cloud.normals), cloud.there)
    assert losses.loss(match_nearest(T, bare, cloud), T, LossSettings()).matched.item() == 0.0


def test_matches_farther_than_the_limit_do_not_count():
    cloud, T = room(), pose(0, 0, 0, 100.0, 0, 0)
    assert match_nearest(T, cloud, cloud, max_distance_m=1.0).weight.sum().item() == 0


def scan_of_a_room(T_world_lidar: torch.Tensor) -> Clouds:
    """Vertex maps of a box of 12 x 8 x 2 m seen from a pose in it, as clouds."""
    elevation = torch.deg2rad(GEOMETRY.fov_up_deg - (torch.arange(20) + 0.5) * GEOMETRY.row_deg).double()[:, None]
    azimuth = torch.deg2rad(180 - (torch.arange(90) + 0.5) * GEOMETRY.column_deg).double()[None]
    flat = torch.ones_like(azimuth)
    rays = torch.stack([elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin() * flat], -1)
    rays = rays.reshape(-1, 3)
    turned = rays @ T_world_lidar[0, :3, :3].T
    half, origin = torch.tensor([6.0, 4.0, 1.0]), T_world_lidar[0, :3, 3]
    ranges = ((half * turned.sign() - origin) / turned).nan_to_num(torch.inf).min(dim=1, keepdim=True).values
    return Clouds.of_maps((rays * ranges).T.reshape(1, 3, 20, 90).float())


@pytest.mark.parametrize("matching", ["same-pixel", "nearest-projected"])
def test_matching_on_the_maps_costs_least_at_the_true_pose(matching):
    T = pose(0, 0, 0.02, 0.3, 0.05, 0.0)
    last, current = scan_of_a_room(pose(0, 0, 0, 0, 0, 0)), scan_of_a_room(T)
    settings = LossSettings(matching=matching, reduction="mean", lambda_=0.0)

    def cost(at: torch.Tensor) -> float:
        return losses.loss(match(at.float(), last, current, settings, GEOMETRY), at.float(), settings).total.item()

    assert cost(T) < 0.01  # corners share cells of both walls
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 0.05
        assert cost(T @ pose(*step)) > 1.5 * cost(T)


def test_the_same_pixel_pairs_what_falls_into_one_cell():
    scan = scan_of_a_room(pose(0, 0, 0, 0, 0, 0))
    matches = match_same_pixel(pose(0, 0, 0, 0, 0, 0).float(), scan, scan, GEOMETRY)
    assert torch.equal(matches.source[matches.weight > 0], matches.target[matches.weight > 0])
    assert matches.share.item() > 0.75


def test_weights_that_make_no_loss_are_refused():
    with pytest.raises(ConfigError):
        LossSettings(alpha=0.0, lambda_=0.0)
