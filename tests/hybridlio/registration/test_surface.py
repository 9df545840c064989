import numpy as np
import pytest
from rooms import FLOOR, ROOM, scene, seen_from, wall

from hybridlio.core import se3
from hybridlio.registration.surface import Neighbours, PlaneMatches, Surface

MOTION = se3.exp(np.array([0.01, -0.02, 0.05, 0.3, -0.2, 0.1]))


def weighted_cost(matches, pose: np.ndarray, weights: np.ndarray) -> float:
    residuals = np.einsum("ij,ij->i", se3.transform(pose, matches.source), matches.planes[:, :3]) - matches.planes[:, 3]
    return float((weights * residuals**2).sum() / 2)


def weights_of(matches, kernel_m: float = 0.1) -> np.ndarray:
    return matches.planes[:, 4] * (kernel_m**2 / (kernel_m**2 + matches.distances**2)) ** 2


def test_gradient_and_hessian_are_those_of_the_weighted_cost(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM))
    pose = se3.exp(np.array([0.02, -0.01, 0.3, 1.0, -0.5, 0.2]))
    source = seen_from(pose, scene(rng, ROOM, 60)[0] + 0.05 * rng.standard_normal((300, 3)))
    matches = Neighbours(surface, source, 1).matches(pose, 1.0)
    system = matches.system(0.1)

    def cost(xi: np.ndarray) -> float:
        return weighted_cost(matches, pose @ se3.exp(xi), weights_of(matches))

    step, axes = 1e-4, np.eye(6)
    gradient = [(cost(step * e) - cost(-step * e)) / (2 * step) for e in axes]
    np.testing.assert_allclose(system.gradient, gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())
    # Gauss-Newton neglects the residuals' curvature; with all points on their planes there is none
    normals = matches.planes[:, :3]
    offsets = np.einsum("ij,ij->i", se3.transform(pose, matches.source), normals)
    flat = PlaneMatches.linearised(pose, matches.source, np.column_stack([normals, offsets, matches.planes[:, 4]]))
    exact = flat.system(0.1)

    def flat_cost(xi: np.ndarray) -> float:
        return weighted_cost(flat, pose @ se3.exp(xi), weights_of(flat))

    hessian = np.array(
        [
            [
                (
                    flat_cost(step * (a + b))
                    - flat_cost(step * (a - b))
                    - flat_cost(step * (b - a))
                    + flat_cost(-step * (a + b))
                )
                / (4 * step**2)
                for a in axes
            ]
            for b in axes
        ]
    )
    np.testing.assert_allclose(exact.hessian, hessian, atol=1e-4 * np.abs(hessian).max())
    np.testing.assert_allclose(exact.gradient, 0.0, atol=1e-9)


def test_weights_are_a_quarter_at_the_kernel_width(rng: np.random.Generator):
    points, normals = wall(rng, *FLOOR)
    lifted = points + np.array([0.0, 0.0, 0.1])
    system = Neighbours(Surface(points, normals), lifted, 1).matches(np.eye(4), 1.0).system(0.1)
    assert system.weight == pytest.approx(0.25 * len(points))
    assert system.squares == pytest.approx(0.25 * len(points) * 0.1**2)
    assert system.cost == pytest.approx(0.5 * len(points))


def test_the_extrapolated_system_equals_one_linearised_at_its_end(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM))
    source = seen_from(MOTION, scene(rng, ROOM, 60)[0] + 0.05 * rng.standard_normal((300, 3)))
    matches, way = Neighbours(surface, source, 1).matches(MOTION, 1.0), np.array([1, -1, 1, 5, 5, -5]) / 1e3
    along = matches.system(0.1, way)
    anew = PlaneMatches.linearised(MOTION @ se3.exp(way), matches.source, matches.planes).system(0.1)
    assert along.squares == pytest.approx(anew.squares, rel=1e-3)
    np.testing.assert_allclose(along.gradient, anew.gradient, atol=2e-3 * np.abs(anew.gradient).max())


def test_followed_neighbours_are_the_nearest(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    surface, source = Surface(points, normals), seen_from(MOTION, scene(rng, ROOM, 200)[0])
    followed, pose = Neighbours(surface, source, 1), np.eye(4)
    for _ in range(8):
        pose = pose @ se3.exp(0.02 * rng.standard_normal(6))
        kept, fresh = followed.matches(pose, 5.0), Neighbours(surface, source, 1).matches(pose, 5.0)
        np.testing.assert_array_equal(kept.planes, fresh.planes)


def test_points_without_a_neighbour_within_the_distance_are_left_out(rng: np.random.Generator):
    points, normals = wall(rng, *FLOOR)
    source = np.concatenate([points, points[:10] + np.array([0.0, 0.0, 0.5])])
    matches = Neighbours(Surface(points, normals), source, 1).matches(np.eye(4), 0.3)
    np.testing.assert_array_equal(matches.source, points)


def test_points_beyond_the_edge_of_a_surface_are_left_out_if_it_has_no_gaps(rng: np.random.Generator):
    side = np.arange(-2, 2.01, 0.25)
    points = np.column_stack([*(grid.ravel() for grid in np.meshgrid(side, side)), np.zeros(len(side) ** 2)])
    surface = Surface(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    source = np.column_stack([rng.uniform(-4, 4, (2000, 2)), rng.uniform(-0.3, 0.3, 2000)])
    beyond_m = np.abs(source[:, :2]).max(axis=1) - 2.0
    for without_edges, reach_m in ((False, 1.0), (True, 0.6)):
        matched = Neighbours(surface, source, 1, without_edges).matches(np.eye(4), 1.0).source
        assert set(map(tuple, source[beyond_m < 0])) <= set(map(tuple, matched))  # all that the surface shows
        farthest_m = np.abs(matched[:, :2]).max() - 2.0
        assert 0.9 * reach_m < farthest_m <= reach_m


def test_the_point_of_a_single_point_surface_is_every_points_neighbour():
    surface = Surface(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    source = np.array([[0.1, 0.0, 0.2], [0.0, 0.3, -0.1]])
    np.testing.assert_allclose(Neighbours(surface, source, 1).matches(np.eye(4), 1.0).distances, [0.2, -0.1])


def test_a_one_sided_wall_is_matched_from_the_side_that_saw_it_and_a_bush_from_both(rng: np.random.Generator):
    points = np.column_stack([np.full(200, 2.0), rng.uniform(-1, 1, (200, 2))])
    normals, weights = np.tile([-1.0, 0.0, 0.0], (200, 1)), np.repeat([1.0, 0.5], 100)  # seen from the origin
    behind = se3.make(np.eye(3), [4.0, 0.0, 0.0])
    for one_sided, matched in ((False, 200), (True, 100)):
        surface = Surface(points, normals, 1, weights, one_sided=one_sided)
        assert len(Neighbours(surface, points, 1).matches(np.eye(4), 1.0)) == 200
        assert len(Neighbours(surface, seen_from(behind, points), 1).matches(behind, 1.0)) == matched
    assert surface.extended(points[:5], normals[:5]).one_sided


def test_a_wall_at_a_grazing_angle_is_matched_although_its_normal_is_not_exact():
    point, normal = np.array([[20.0, 1.0, 0.0]]), np.array([[0.08, -1.0, 0.0]]) / np.hypot(0.08, 1.0)
    surface = Surface(point, normal, 1, one_sided=True)  # by its normal it is seen from 2° behind
    assert len(Neighbours(surface, point, 1).matches(np.eye(4), 1.0)) == 1
