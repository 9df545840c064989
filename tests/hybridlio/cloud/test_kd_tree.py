import numpy as np
import pytest

from hybridlio.cloud.kd_tree import GrowingKdTree
from hybridlio.registration.surface import Surface


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
    index, first2, second2 = tree.two_nearest(queries, threads)
    np.testing.assert_array_equal(index, order[:, 0])
    np.testing.assert_allclose(first2, distance2[:, 0], rtol=1e-9)
    others2 = distance2[:, 1] if sizes[-1] > 1 else np.full(len(queries), np.inf)
    np.testing.assert_allclose(np.minimum(second2, 1.0), np.minimum(others2, 1.0), rtol=1e-9)
    assert (second2 <= others2 * (1 + 1e-9)).all()


def test_extending_a_tree_leaves_it_unchanged(rng: np.random.Generator):
    points, queries = rng.uniform(-10, 10, (300, 3)), rng.uniform(-10, 10, (50, 3))
    first = GrowingKdTree(points[:200], 1)
    once = first.extended(points[:250], 1)
    before = [tree.two_nearest(queries, 1) for tree in (first, once)]
    once.extended(points, 1)
    for tree, found in zip((first, once), before, strict=True):
        for now, then in zip(tree.two_nearest(queries, 1), found, strict=True):
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
    (index, free), (grown_index, grown_free) = (surface.nearest_with_margin(queries, 1) for surface in (whole, grown))
    np.testing.assert_array_equal(index, grown_index)
    assert (grown_free <= free + 1e-12).all()
    assert np.mean(grown_free > free - 1e-12) > 0.5
