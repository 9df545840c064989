import numpy as np
import pytest

from hybridlio.cloud.kd_tree import GrowingKdTree
from hybridlio.core import se3
from hybridlio.registration.surface import Neighbours, Surface


def brute(points: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order of all points by distance, and their squared distances in it."""
    distance2 = ((queries[:, None] - points) ** 2).sum(axis=2)
    order = np.argsort(distance2, axis=1)
    return order, np.take_along_axis(distance2, order, axis=1)


def grown_by_steps(points: np.ndarray, sizes: list[int]) -> GrowingKdTree:
    tree = GrowingKdTree(points[: sizes[0]], 1)
    for size in sizes[1:]:
        tree = tree.extended(points[:size], 1)
    return tree


@pytest.mark.parametrize("sizes", [[400], [399, 400], [300, 350, 400], [1, 2], [1], [2, 3], [40, 400]], ids=str)
@pytest.mark.parametrize(("threads", "half_m"), [(1, 10.0), (2, 3.0), (1, 1e4)])
def test_an_extended_tree_finds_what_one_tree_over_all_points_finds(
    rng: np.random.Generator, sizes: list[int], threads: int, half_m: float
):
    points, queries = rng.uniform(-half_m, half_m, (sizes[-1], 3)), 1.1 * rng.uniform(-half_m, half_m, (4500, 3))
    tree = grown_by_steps(points, sizes)
    order, distance2 = brute(points, queries)
    index, nearest2 = tree.nearest(queries, threads)
    np.testing.assert_array_equal(index, order[:, 0])
    np.testing.assert_allclose(nearest2, distance2[:, 0], rtol=1e-9)
    count = 3
    more = np.full((len(queries), count), np.inf)
    distance2 = np.column_stack([distance2, more])[:, : count + 1]
    index, found2, others2 = tree.several_nearest(queries, count, threads)
    np.testing.assert_array_equal(index[:, 0], order[:, 0])
    np.testing.assert_allclose(found2[:, 0], distance2[:, 0], rtol=1e-9)
    np.testing.assert_allclose(np.minimum(found2, 1.0), np.minimum(distance2[:, :count], 1.0), rtol=1e-9)
    known = np.isfinite(found2)
    to_found2 = ((queries[:, None] - points[index]) ** 2).sum(axis=2)
    np.testing.assert_allclose(found2[known], to_found2[known], rtol=1e-9)
    assert (others2 <= distance2[:, count - 1] * (1 + 1e-9)).all()
    np.testing.assert_allclose(np.minimum(others2, 1.0), np.minimum(distance2[:, count - 1], 1.0), rtol=1e-9)


def test_extending_a_tree_leaves_it_unchanged(rng: np.random.Generator):
    points, queries = rng.uniform(-10, 10, (300, 3)), rng.uniform(-10, 10, (50, 3))
    first = GrowingKdTree(points[:200], 1)
    once = first.extended(points[:250], 1)
    before = [tree.several_nearest(queries, 3, 1) for tree in (first, once)]
    once.extended(points, 1)
    for tree, found in zip((first, once), before, strict=True):
        for now, then in zip(tree.several_nearest(queries, 3, 1), found, strict=True):
            np.testing.assert_array_equal(now, then)
    assert [len(first), len(once), len(once.extended(points, 1))] == [200, 250, 300]
    assert [tree.appended_ratio for tree in (first, once)] == [0.0, 0.25]


def test_an_extended_surface_equals_one_built_from_all_points(rng: np.random.Generator):
    points, normals = rng.uniform(-5, 5, (500, 3)), rng.standard_normal((500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    whole, grown = Surface(points, normals), Surface(points[:400], normals[:400])
    for start, end in ((400, 450), (450, 500)):
        grown = grown.extended(points[start:end], normals[start:end])
    np.testing.assert_array_equal(grown.points, points)
    np.testing.assert_array_equal(grown.normals, normals)
    np.testing.assert_array_equal(grown.planes(np.arange(500)), whole.planes(np.arange(500)))
    queries = points + 0.1 * rng.standard_normal((500, 3))
    all_at_once, by_parts = (surface.candidates(queries, 1) for surface in (whole, grown))
    np.testing.assert_array_equal(all_at_once.nearest[:, 0], by_parts.nearest[:, 0])
    for free, grown_free in ((all_at_once.own_m, by_parts.own_m), (all_at_once.reach_m, by_parts.reach_m)):
        assert (grown_free <= free + 1e-12).all()
        assert np.mean(grown_free > free - 1e-12) > 0.5


def test_a_tree_that_is_searched_often_becomes_one_when_it_is_extended(rng: np.random.Generator):
    points, queries = rng.uniform(-10, 10, (400, 3)), rng.uniform(-10, 10, (300, 3))
    seldom, often = (GrowingKdTree(points[:300], 1).extended(points[:350], 1) for _ in range(2))
    often.nearest(queries, 1)
    assert (often.appended_ratio, seldom.appended_ratio) == (50 / 300, 50 / 300)
    for tree, settled in ((seldom, 300), (often, 400)):
        grown = tree.extended(points, 1)
        assert grown.__getstate__()[2] == settled
        assert grown.appended_ratio == 100 / 300  # since it was made
        np.testing.assert_array_equal(grown.nearest(queries, 1)[0], brute(points, queries)[0][:, 0])


def test_neighbours_that_are_followed_are_the_nearest_at_every_pose(rng: np.random.Generator):
    """Over moves of millimetres to decimetres, back and forth, with and without a search."""
    points, source = rng.uniform(-2, 2, (1500, 3)), rng.uniform(-2, 2, (400, 3))
    normals = rng.standard_normal((1500, 3))
    surface = Surface(points[:1400], normals[:1400]).extended(points[1400:], normals[1400:])
    neighbours = Neighbours(surface, source, 1)
    for size in (0.0, 0.003, 0.01, 0.03, 0.1, 0.03, 0.3, 0.01):
        pose = se3.exp(size * rng.standard_normal(6))
        index, kept = neighbours.within(pose, 10.0)
        np.testing.assert_array_equal(kept, source)
        np.testing.assert_array_equal(index, brute(points, se3.transform(pose, source))[0][:, 0])
