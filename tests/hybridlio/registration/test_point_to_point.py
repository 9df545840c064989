"""Points in thick neighbourhoods are matched with points: exact derivatives, one kernel over the difference."""

import numpy as np
import pytest
from rooms import ROOM, scene, seen_from

from hybridlio.core import se3
from hybridlio.registration.icp import register
from hybridlio.registration.point_to_point import MixedNeighbours
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

POSE = se3.exp(np.array([0.02, -0.01, 0.3, 1.0, -0.5, 0.2]))
THICK, FLAT = 0.4, 1.0


def bush(rng: np.random.Generator, count: int = 400) -> np.ndarray:
    return np.array([4.0, 2.0, 0.5]) + rng.uniform(-1, 1, (count, 3))


def leaning_anywhere(rng: np.random.Generator, count: int) -> np.ndarray:
    normals = rng.standard_normal((count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def with_a_bush(rng: np.random.Generator) -> Surface:
    points, normals = scene(rng, ROOM)
    leaves = bush(rng)
    weights = np.concatenate([np.full(len(points), FLAT), np.full(len(leaves), THICK)])
    normals = np.concatenate([normals, leaning_anywhere(rng, len(leaves))])
    return Surface(np.concatenate([points, leaves]), normals, 1, weights)


def weights_of(own: np.ndarray, of_square: np.ndarray, lengths_m: np.ndarray, kernel_m: float = 0.1) -> np.ndarray:
    return own * (kernel_m**2 / (kernel_m**2 + of_square * lengths_m**2)) ** 2


def test_gradient_and_hessian_are_those_of_the_weighted_squares(rng: np.random.Generator):
    surface = with_a_bush(rng)
    source = seen_from(POSE, surface.points[::7] + 0.05 * rng.standard_normal((len(surface.points[::7]), 3)))
    mixed = MixedNeighbours(surface, source, 1).mixed(POSE, 1.0)
    system = mixed.system(0.1)
    assert 0 < len(mixed.source) < len(mixed)
    targets = surface.points[surface.nearest(se3.transform(POSE, mixed.source), 1)[0]]
    flat_weights = weights_of(mixed.planes.planes[:, 4], np.ones(len(mixed.planes)), mixed.planes.distances)
    lengths = np.linalg.norm(mixed.rows.points[6], axis=0)
    weights = weights_of(mixed.rows.point_weights, mixed.rows.point_weights, lengths)
    assert system.weight == pytest.approx(flat_weights.sum() + weights.sum())

    def off(xi: np.ndarray) -> np.ndarray:
        pose, planes = POSE @ se3.exp(xi), mixed.planes.planes
        flat = np.einsum("ij,ij->i", se3.transform(pose, mixed.planes.source), planes[:, :3]) - planes[:, 3]
        thick = (se3.transform(pose, mixed.source) - targets) * np.sqrt(weights)[:, None]
        return np.concatenate([flat * np.sqrt(flat_weights), thick.ravel()])

    step = 1e-6
    derivatives = np.column_stack([(off(step * e) - off(-step * e)) / (2 * step) for e in np.eye(6)])
    np.testing.assert_allclose(system.gradient, derivatives.T @ off(np.zeros(6)), rtol=1e-6)
    np.testing.assert_allclose(system.hessian, derivatives.T @ derivatives, rtol=1e-6, atol=1e-5)


def test_linear_extrapolation_equals_matching_at_the_displaced_pose(rng: np.random.Generator):
    surface, xi = with_a_bush(rng), np.array([2e-5, -1e-5, 3e-5, 2e-3, -1e-3, 5e-4])
    neighbours = MixedNeighbours(surface, seen_from(POSE, surface.points[::7] + 0.004), 1)
    way, there = neighbours.mixed(POSE, 1.0).system(0.1, xi), neighbours.mixed(POSE @ se3.exp(xi), 1.0).system(0.1)
    assert way.squares == pytest.approx(there.squares, rel=1e-4)
    np.testing.assert_allclose(way.gradient, there.gradient, atol=1e-3 * np.abs(there.gradient).max())


def test_thin_planes_give_the_point_to_plane_system(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM))
    neighbours = MixedNeighbours(surface, seen_from(POSE, scene(rng, ROOM, 60)[0]), 1)
    mixed, flat = neighbours.mixed(POSE, 1.0).system(0.1), neighbours.matches(POSE, 1.0).system(0.1)
    np.testing.assert_allclose(mixed.hessian, flat.hessian)
    np.testing.assert_allclose(mixed.gradient, flat.gradient)


def test_the_kernel_is_over_the_length_of_the_difference():
    """Neighbours of weight 0.5: the weighted distance equals the kernel at √2 kernels, where a quarter is left."""
    targets = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    surface = Surface(targets, np.tile([0.0, 0.0, 1.0], (2, 1)), 1, np.full(2, 0.5))
    off = np.array([[0.0, 0.1 * np.sqrt(2), 0.0], [0.0, 0.0, 0.0]])
    system = MixedNeighbours(surface, targets + off, 1).mixed(np.eye(4), 1.0).system(0.1)
    assert system.weight == pytest.approx(0.125 + 0.5)
    np.testing.assert_allclose(np.diag(system.hessian)[3:], 0.625)


def test_a_bush_is_registered_better_by_points_than_by_planes(rng: np.random.Generator):
    start = POSE @ se3.exp(np.array([0.0, 0.0, 0.0, 0.08, -0.06, 0.05]))
    settings, held = RegistrationSettings(kernel_m=0.03, threads=1), np.empty((6, 0))
    errors_m = []
    for _ in range(12):
        leaves = bush(rng, 200)
        surface = Surface(leaves, leaning_anywhere(rng, len(leaves)), 1, np.full(len(leaves), THICK))
        source = seen_from(POSE, leaves[::2] + 0.02 * rng.standard_normal((len(leaves[::2]), 3)))
        both = [
            register(surface, source, start, settings, 0.1, held, match_thick_as_points=thick)
            for thick in (True, False)
        ]
        errors_m.append([np.linalg.norm(se3.log(se3.between(POSE, found.pose))[3:]) for found in both])
    by_points_m, by_planes_m = np.mean(errors_m, axis=0)
    assert by_points_m < 0.02
    assert by_points_m < 0.7 * by_planes_m
