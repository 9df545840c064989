import numpy as np
import pytest

from hybridlio import se3
from hybridlio.information import covariance_of, degenerate_directions, scaled_spectrum
from hybridlio.registration import RegistrationSettings, register
from hybridlio.surface import Matches, Neighbours, Surface

EXACT = RegistrationSettings(threads=1)
MOTION = se3.exp(np.array([0.01, -0.02, 0.05, 0.3, -0.2, 0.1]))


def wall(
    rng: np.random.Generator, origin: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], count: int = 800
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a parallelogram, and its normal for each."""
    a, b = np.array(u, float), np.array(v, float)
    points = np.array(origin, float) + rng.random((count, 1)) * a + rng.random((count, 1)) * b
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    return points, np.tile(normal, (count, 1))


FLOOR = ((-10, -8, -2), (20, 0, 0), (0, 16, 0))
NORTH, SOUTH = ((-10, 8, -2), (20, 0, 0), (0, 0, 5)), ((-10, -8, -2), (20, 0, 0), (0, 0, 5))
EAST, WEST = ((10, -8, -2), (0, 16, 0), (0, 0, 5)), ((-10, -8, -2), (0, 16, 0), (0, 0, 5))
ROOM, CORRIDOR, PLAIN = (FLOOR, NORTH, SOUTH, EAST, WEST), (FLOOR, NORTH, SOUTH), (FLOOR,)


def scene(rng: np.random.Generator, walls: tuple, count: int = 800) -> tuple[np.ndarray, np.ndarray]:
    parts = [wall(rng, *w, count=count) for w in walls]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return se3.transform(se3.inverse(pose), points)


def off(found: np.ndarray, truth: np.ndarray = MOTION) -> np.ndarray:
    return se3.log(se3.between(found, truth))


# ------------------------------------------------------------------------------------------------------- motion


@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (1, -1, 5), (-2, 2, -8)], ids=str)
def test_a_known_motion_in_a_room_is_recovered(rng: np.random.Generator, angles_deg: tuple[float, ...]):
    truth = se3.exp(np.r_[np.radians(angles_deg), 0.3, -0.2, 0.1])
    surface = Surface(*scene(rng, ROOM, 4000))
    other_points, _ = scene(rng, ROOM, 300)  # of the same walls, not the same points
    found = register(surface, seen_from(truth, other_points), np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose, truth)
    assert found.converged
    # where neighbours lie around a corner from each other the other wall's normal is the wrong one; few do
    assert np.abs(error[:3]).max() < 2e-4
    assert np.abs(error[3:]).max() < 2e-3
    assert found.matched == pytest.approx(1.0, abs=0.02)


def test_the_very_same_points_are_laid_on_themselves_exactly(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    small = se3.exp(np.array([1e-3, -1e-3, 2e-3, 0.02, 0.01, -0.02]))
    found = register(Surface(points, normals), seen_from(small, points), np.eye(4), EXACT)
    np.testing.assert_allclose(off(found.pose, small), 0.0, atol=1e-6)
    assert found.sigma_m < 1e-4  # as it was before the last step
    assert found.cost < 1e-6


def test_noise_of_the_points_averages_out(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    points, _ = scene(rng, ROOM, 600)
    source = seen_from(MOTION, points + 0.02 * rng.standard_normal(points.shape))
    found = register(surface, source, np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose)
    assert np.abs(error[3:]).max() < 4 * 0.02 / np.sqrt(600)
    assert found.sigma_m == pytest.approx(0.02, rel=0.2)


def test_one_point_in_five_being_something_else_does_no_harm(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    points, _ = scene(rng, ROOM, 400)
    wrong = rng.random(len(points)) < 0.2
    points[wrong] = rng.uniform([-9, -7, -1.5], [9, 7, 2.5], (wrong.sum(), 3))
    points += 0.01 * rng.standard_normal(points.shape)
    found = register(surface, seen_from(MOTION, points), np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose)
    assert np.abs(error[:3]).max() < 1e-3
    assert np.abs(error[3:]).max() < 0.01


def test_the_answer_does_not_depend_on_where_near_by_it_starts(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    source = seen_from(MOTION, scene(rng, ROOM, 400)[0])
    answers = [
        register(surface, source, MOTION @ se3.exp(xi), EXACT, kernel_start_m=0.5).pose
        for xi in 0.05 * rng.standard_normal((4, 6))
    ]
    for pose in answers[1:]:
        np.testing.assert_allclose(off(pose, answers[0]), 0.0, atol=2e-3)


# ------------------------------------------------------------------------------------------- gradient and Hessian


def weighted_cost(matches, pose: np.ndarray, weights: np.ndarray) -> float:
    residuals = np.einsum("ij,ij->i", se3.transform(pose, matches.source), matches.planes[:, :3]) - matches.planes[:, 3]
    return float((weights * residuals**2).sum() / 2)


def test_gradient_and_hessian_are_those_of_the_weighted_cost(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM))
    pose = se3.exp(np.array([0.02, -0.01, 0.3, 1.0, -0.5, 0.2]))
    source = seen_from(pose, scene(rng, ROOM, 60)[0] + 0.05 * rng.standard_normal((300, 3)))
    matches = Neighbours(surface, source, 1).matches(pose, 1.0)
    system = matches.system(0.1)

    def cost(xi: np.ndarray) -> float:
        return weighted_cost(matches, pose @ se3.exp(xi), system.weights)

    step, axes = 1e-4, np.eye(6)
    gradient = [(cost(step * e) - cost(-step * e)) / (2 * step) for e in axes]
    np.testing.assert_allclose(system.gradient, gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())
    # Gauss-Newton leaves out the residuals' curvature: put the points on their planes and there is none
    normals = matches.planes[:, :3]
    offsets = np.einsum("ij,ij->i", se3.transform(pose, matches.source), normals)
    flat = Matches.of(pose, matches.source, np.column_stack([normals, offsets]))
    exact = flat.system(0.1)

    def flat_cost(xi: np.ndarray) -> float:
        return weighted_cost(flat, pose @ se3.exp(xi), exact.weights)

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


def test_weights_fall_to_a_quarter_at_the_kernel(rng: np.random.Generator):
    points, normals = wall(rng, *FLOOR)
    lifted = points + np.array([0.0, 0.0, 0.1])
    system = Neighbours(Surface(points, normals), lifted, 1).matches(np.eye(4), 1.0).system(0.1)
    np.testing.assert_allclose(system.weights, 0.25, rtol=1e-6)


def test_along_a_small_way_the_system_is_as_good_as_that_made_anew_at_its_end(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM))
    source = seen_from(MOTION, scene(rng, ROOM, 60)[0] + 0.05 * rng.standard_normal((300, 3)))
    matches, way = Neighbours(surface, source, 1).matches(MOTION, 1.0), np.array([1, -1, 1, 5, 5, -5]) / 1e3
    along = matches.system(0.1, way)
    anew = Matches.of(MOTION @ se3.exp(way), matches.source, matches.planes).system(0.1)
    np.testing.assert_allclose(along.distances, anew.distances, atol=2e-5)
    np.testing.assert_allclose(along.gradient, anew.gradient, atol=2e-3 * np.abs(anew.gradient).max())


def test_neighbours_that_are_not_looked_for_anew_are_the_nearest_all_the_same(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    surface, source = Surface(points, normals), seen_from(MOTION, scene(rng, ROOM, 200)[0])
    followed, pose = Neighbours(surface, source, 1), np.eye(4)
    for _ in range(8):
        pose = pose @ se3.exp(0.02 * rng.standard_normal(6))
        kept, fresh = followed.matches(pose, 5.0), Neighbours(surface, source, 1).matches(pose, 5.0)
        np.testing.assert_array_equal(kept.planes, fresh.planes)


def test_points_without_a_neighbour_within_reach_are_left_out(rng: np.random.Generator):
    points, normals = wall(rng, *FLOOR)
    source = np.concatenate([points, points[:10] + np.array([0.0, 0.0, 0.5])])
    matches = Neighbours(Surface(points, normals), source, 1).matches(np.eye(4), 0.3)
    np.testing.assert_array_equal(matches.source, points)


def test_a_surface_of_one_point_is_everyones_neighbour():
    surface = Surface(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    source = np.array([[0.1, 0.0, 0.2], [0.0, 0.3, -0.1]])
    np.testing.assert_allclose(Neighbours(surface, source, 1).matches(np.eye(4), 1.0).rows[6], [0.2, -0.1])


# ------------------------------------------------------------------------------------------------ degeneracy


def hessian_of(rng: np.random.Generator, walls: tuple, roughness: float = 0.01) -> np.ndarray:
    points, normals = scene(rng, walls, 2000)
    normals = normals + roughness * rng.standard_normal(normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return register(Surface(points, normals), points[::5], np.eye(4), EXACT).hessian


def test_a_room_has_no_degenerate_direction(rng: np.random.Generator):
    assert degenerate_directions(hessian_of(rng, ROOM)).shape == (0, 6)


def test_a_corridors_degenerate_direction_is_its_axis(rng: np.random.Generator):
    (direction,) = degenerate_directions(hessian_of(rng, CORRIDOR))
    assert abs(direction[3]) > 0.99


def test_a_plains_degenerate_directions_are_two_shifts_and_the_turn_about_its_normal(rng: np.random.Generator):
    directions = degenerate_directions(hessian_of(rng, PLAIN))
    assert directions.shape == (3, 6)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    # they span the turn about z and the shifts along x and y: nothing of the other three
    assert np.abs(directions[:, [0, 1, 5]]).max() < 0.1
    assert np.linalg.matrix_rank(directions[:, [2, 3, 4]], tol=0.1) == 3


def test_a_pose_stays_where_it_is_along_what_the_points_do_not_say(rng: np.random.Generator):
    points, normals = scene(rng, CORRIDOR, 2000)
    truth = se3.exp(np.array([0.0, 0.0, 0.02, 0.0, 0.15, -0.1]))
    guess = se3.exp(np.array([0.0, 0.0, 0.0, 0.7, 0.0, 0.0]))
    inside = points[np.abs(points[:, 0]) < 7][::5]
    found = register(Surface(points, normals), seen_from(truth, inside), guess, EXACT, kernel_start_m=0.5).pose
    assert found[0, 3] == pytest.approx(0.7, abs=0.05)  # along: as it was given
    np.testing.assert_allclose(off(found, truth)[[0, 1, 2, 5]], 0.0, atol=2e-3)
    assert abs(off(found, truth)[4]) < 0.03


def test_the_spectrum_puts_turns_and_shifts_in_one_unit(rng: np.random.Generator):
    hessian = hessian_of(rng, ROOM)
    values, vectors, scale = scaled_spectrum(hessian)
    np.testing.assert_allclose(
        vectors @ np.diag(values) @ vectors.T, hessian * np.outer(scale, scale), rtol=1e-9, atol=1e-6
    )
    scaled = np.diag(hessian * np.outer(scale, scale))
    assert scaled[:3].sum() == pytest.approx(scaled[3:].sum())
    # metres in place of kilometres, or a scan of twice the size, change no direction's share
    metres = np.diag(np.r_[np.full(3, 1e-3), np.ones(3)])
    np.testing.assert_allclose(scaled_spectrum(metres @ hessian @ metres)[0], values, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ covariance


@pytest.mark.parametrize("walls", [ROOM, CORRIDOR, PLAIN], ids=["room", "corridor", "plain"])
def test_the_covariance_is_symmetric_positive_definite_and_loose_only_where_degenerate(
    rng: np.random.Generator, walls: tuple
):
    points, normals = scene(rng, walls, 2000)
    normals = normals + 0.01 * rng.standard_normal(normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source = points[::5] + 0.02 * rng.standard_normal(points[::5].shape)
    found = register(Surface(points, normals), source, np.eye(4), EXACT)
    covariance = covariance_of(found.hessian, found.sigma_m, 6.0)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-12)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    sigmas = np.sqrt(np.diag(covariance))
    loose = {ROOM: [], CORRIDOR: [3], PLAIN: [3, 4]}[walls]
    assert (sigmas[loose] > 1.0).all()
    tight = [k for k in (3, 4, 5) if k not in loose]
    assert (sigmas[tight] < 0.05).all()
    assert (sigmas[:2] < 0.01).all()
    assert (sigmas[2] > 0.1) == (walls is PLAIN)


def test_the_covariance_is_of_a_right_perturbation(rng: np.random.Generator):
    """Turning the world leaves it; turning the scan turns it."""
    points, normals = scene(rng, CORRIDOR, 2000)
    source = points[::5] + 0.02 * rng.standard_normal(points[::5].shape)
    turn = se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    world = register(Surface(se3.transform(turn, points), normals @ turn[:3, :3].T), source, turn, EXACT)
    scan = register(Surface(points, normals), seen_from(turn, source), turn, EXACT)
    # in the first the corridor still runs along the scan's x; in the second along its y
    assert np.argmax(np.diag(covariance_of(world.hessian, world.sigma_m, 1.0))) == 3
    assert np.argmax(np.diag(covariance_of(scan.hessian, scan.sigma_m, 1.0))) == 4


def test_twice_the_residuals_are_four_times_the_covariance(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    surface, noise, traces = Surface(points, normals), rng.standard_normal(points.shape), []
    for sigma in (0.01, 0.02):
        found = register(surface, points + sigma * noise, np.eye(4), RegistrationSettings(kernel_m=1.0, threads=1))
        traces.append(np.trace(covariance_of(found.hessian, found.sigma_m, 1e4)))
    assert traces[1] / traces[0] == pytest.approx(4.0, rel=0.1)


def test_the_errors_of_many_registrations_scatter_as_their_covariance_says(rng: np.random.Generator):
    """Of independent residuals on exact planes, scale 1 is the truth."""
    surface = Surface(*scene(rng, ROOM, 4000))
    nees = []
    for _ in range(60):
        points, _ = scene(rng, ROOM, 60)
        inside = points * 0.95  # away from corners, where a neighbour may lie on another wall
        inside[:, 2] = points[:, 2]
        source = seen_from(MOTION, points + 0.02 * rng.standard_normal(points.shape))
        found = register(surface, source, MOTION, EXACT)
        error = off(found.pose)
        nees.append(error @ np.linalg.solve(covariance_of(found.hessian, found.sigma_m, 1.0), error) / 6)
    assert 0.6 < np.mean(nees) < 1.5


# ------------------------------------------------------------------------------------------------- little input


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_leave_the_pose_as_it_was(rng: np.random.Generator, count: int):
    points, normals = scene(rng, ROOM)
    found = register(Surface(points, normals), points[:count] + 0.1, MOTION, EXACT)
    np.testing.assert_allclose(found.pose, MOTION, atol=1e-12)
    assert np.isfinite(covariance_of(found.hessian, found.sigma_m, 1.0)).all()
    assert np.linalg.eigvalsh(covariance_of(found.hessian, found.sigma_m, 1.0))[0] > 0


def test_points_far_from_everything_match_nothing_and_cost_all(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    found = register(Surface(points, normals), points + 1000.0, np.eye(4), EXACT)
    assert found.matched == 0.0
    assert found.cost == 1.0
    np.testing.assert_array_equal(found.pose, np.eye(4))


def test_the_same_input_gives_the_same_bytes(rng: np.random.Generator):
    points, normals = scene(rng, ROOM, 3000)
    source = seen_from(MOTION, scene(rng, ROOM, 400)[0])
    settings = RegistrationSettings(threads=2)
    first, again = (register(Surface(points, normals, 2), source, np.eye(4), settings) for _ in range(2))
    assert first.pose.tobytes() == again.pose.tobytes()
    assert first.hessian.tobytes() == again.hessian.tobytes()
