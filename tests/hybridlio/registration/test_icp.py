import numpy as np
import pytest
from rooms import ROOM, scene, seen_from

from hybridlio.core import se3
from hybridlio.registration.icp import register
from hybridlio.registration.information import covariance_of
from hybridlio.registration.results import Registration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

EXACT = RegistrationSettings(threads=1)
MOTION = se3.exp(np.array([0.01, -0.02, 0.05, 0.3, -0.2, 0.1]))


def off(found: np.ndarray, truth: np.ndarray = MOTION) -> np.ndarray:
    return se3.log(se3.between(found, truth))


# ------------------------------------------------------------------------------------------------------- motion


@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (1, -1, 5), (-2, 2, -8)], ids=str)
def test_a_known_motion_in_a_room_is_recovered(rng: np.random.Generator, angles_deg: tuple[float, ...]):
    truth = se3.exp(np.r_[np.radians(angles_deg), 0.3, -0.2, 0.1])
    surface = Surface(*scene(rng, ROOM, 4000))
    other_points, _ = scene(rng, ROOM, 300)  # on the same walls, but other points
    found = register(surface, seen_from(truth, other_points), np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose, truth)
    assert found.converged
    # a few points near corners have a neighbour on the other wall, with the wrong normal
    assert np.abs(error[:3]).max() < 2e-4
    assert np.abs(error[3:]).max() < 2e-3
    assert found.matched == pytest.approx(1.0, abs=0.02)


def test_identical_points_are_registered_exactly(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    small = se3.exp(np.array([1e-3, -1e-3, 2e-3, 0.02, 0.01, -0.02]))
    found = register(Surface(points, normals), seen_from(small, points), np.eye(4), EXACT)
    np.testing.assert_allclose(off(found.pose, small), 0.0, atol=1e-6)
    assert found.sigma_m < 1e-4  # evaluated before the last step
    assert found.cost < 1e-6


def test_noise_of_the_points_averages_out(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    points, _ = scene(rng, ROOM, 600)
    source = seen_from(MOTION, points + 0.02 * rng.standard_normal(points.shape))
    found = register(surface, source, np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose)
    assert np.abs(error[3:]).max() < 4 * 0.02 / np.sqrt(600)
    assert found.sigma_m == pytest.approx(0.02, rel=0.2)


def test_twenty_percent_outliers_do_no_harm(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    points, _ = scene(rng, ROOM, 400)
    wrong = rng.random(len(points)) < 0.2
    points[wrong] = rng.uniform([-9, -7, -1.5], [9, 7, 2.5], (wrong.sum(), 3))
    points += 0.01 * rng.standard_normal(points.shape)
    found = register(surface, seen_from(MOTION, points), np.eye(4), EXACT, kernel_start_m=1.0)
    error = off(found.pose)
    assert np.abs(error[:3]).max() < 1e-3
    assert np.abs(error[3:]).max() < 0.01


def test_the_result_does_not_depend_on_a_start_nearby(rng: np.random.Generator):
    surface = Surface(*scene(rng, ROOM, 4000))
    source = seen_from(MOTION, scene(rng, ROOM, 400)[0])
    answers = [
        register(surface, source, MOTION @ se3.exp(xi), EXACT, kernel_start_m=0.5).pose
        for xi in 0.05 * rng.standard_normal((4, 6))
    ]
    for pose in answers[1:]:
        np.testing.assert_allclose(off(pose, answers[0]), 0.0, atol=2e-3)


# ------------------------------------------------------------------------------------------------- little input


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_leave_the_pose_unchanged(rng: np.random.Generator, count: int):
    points, normals = scene(rng, ROOM)
    found = register(Surface(points, normals), points[:count] + 0.1, MOTION, EXACT)
    np.testing.assert_allclose(found.pose, MOTION, atol=1e-12)
    assert np.isfinite(covariance_of(found.hessian, found.sigma_m, 1.0)).all()
    assert np.linalg.eigvalsh(covariance_of(found.hessian, found.sigma_m, 1.0))[0] > 0


def test_points_far_from_the_surface_match_nothing_and_cost_1(rng: np.random.Generator):
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


def test_a_fit_within_coverage_counts_the_points_that_could_match() -> None:
    found = Registration(np.eye(4), np.eye(6), np.ones(3), 0.02, matched=0.4, cost=0.7, iterations=3, converged=True)
    covered = found.within_coverage(0.5)
    assert covered.matched == pytest.approx(0.8)
    assert covered.cost == pytest.approx(0.4)
    assert found.within_coverage(1.0).fit == pytest.approx(found.fit)
    assert found.within_coverage(np.inf).fit == pytest.approx(found.fit)
    nothing = found.within_coverage(0.0)  # of a map that covers next to nothing, a poor fit stays one
    assert nothing.matched <= 1
    assert 0 <= nothing.cost < found.cost
