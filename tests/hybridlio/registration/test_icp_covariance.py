import numpy as np
import pytest
from rooms import CORRIDOR, PLAIN, ROOM, scene, seen_from

from hybridlio.core import se3
from hybridlio.registration.icp import register
from hybridlio.registration.information import covariance_of, degenerate_directions, scaled_spectrum
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

EXACT = RegistrationSettings(threads=1)
MOTION = se3.exp(np.array([0.01, -0.02, 0.05, 0.3, -0.2, 0.1]))


def off(found: np.ndarray, truth: np.ndarray = MOTION) -> np.ndarray:
    return se3.log(se3.between(found, truth))


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


def test_a_planes_degenerate_directions_are_two_translations_and_yaw(rng: np.random.Generator):
    directions = degenerate_directions(hessian_of(rng, PLAIN))
    assert directions.shape == (3, 6)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    # they span the rotation about z and the translations along x and y, and nothing else
    assert np.abs(directions[:, [0, 1, 5]]).max() < 0.1
    assert np.linalg.matrix_rank(directions[:, [2, 3, 4]], tol=0.1) == 3


def test_a_pose_stays_at_the_initial_one_along_unconstrained_directions(rng: np.random.Generator):
    points, normals = scene(rng, CORRIDOR, 2000)
    truth = se3.exp(np.array([0.0, 0.0, 0.02, 0.0, 0.15, -0.1]))
    guess = se3.exp(np.array([0.0, 0.0, 0.0, 0.7, 0.0, 0.0]))
    inside = points[np.abs(points[:, 0]) < 7][::5]
    found = register(Surface(points, normals), seen_from(truth, inside), guess, EXACT, kernel_start_m=0.5).pose
    assert found[0, 3] == pytest.approx(0.7, abs=0.05)  # along the corridor: as initially
    np.testing.assert_allclose(off(found, truth)[[0, 1, 2, 5]], 0.0, atol=2e-3)
    assert abs(off(found, truth)[4]) < 0.03


def test_the_spectrum_has_rotations_and_translations_in_one_unit(rng: np.random.Generator):
    hessian = hessian_of(rng, ROOM)
    values, vectors, scale = scaled_spectrum(hessian)
    np.testing.assert_allclose(
        vectors @ np.diag(values) @ vectors.T, hessian * np.outer(scale, scale), rtol=1e-9, atol=1e-6
    )
    scaled = np.diag(hessian * np.outer(scale, scale))
    assert scaled[:3].sum() == pytest.approx(scaled[3:].sum())
    # the spectrum does not depend on the unit of length
    metres = np.diag(np.r_[np.full(3, 1e-3), np.ones(3)])
    np.testing.assert_allclose(scaled_spectrum(metres @ hessian @ metres)[0], values, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ covariance


@pytest.mark.parametrize("walls", [ROOM, CORRIDOR, PLAIN], ids=["room", "corridor", "plain"])
def test_the_covariance_is_positive_definite_and_large_only_where_degenerate(rng: np.random.Generator, walls: tuple):
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
    """Rotating the world does not change it; rotating the scan rotates it."""
    points, normals = scene(rng, CORRIDOR, 2000)
    source = points[::5] + 0.02 * rng.standard_normal(points[::5].shape)
    turn = se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    world = register(Surface(se3.transform(turn, points), normals @ turn[:3, :3].T), source, turn, EXACT)
    scan = register(Surface(points, normals), seen_from(turn, source), turn, EXACT)
    # the corridor runs along the scan's x in the first, and along its y in the second
    assert np.argmax(np.diag(covariance_of(world.hessian, world.sigma_m, 1.0))) == 3
    assert np.argmax(np.diag(covariance_of(scan.hessian, scan.sigma_m, 1.0))) == 4


def test_twice_the_noise_gives_four_times_the_covariance(rng: np.random.Generator):
    points, normals = scene(rng, ROOM)
    surface, noise, traces = Surface(points, normals), rng.standard_normal(points.shape), []
    for sigma in (0.01, 0.02):
        found = register(surface, points + sigma * noise, np.eye(4), RegistrationSettings(kernel_m=1.0, threads=1))
        traces.append(np.trace(covariance_of(found.hessian, found.sigma_m, 1e4)))
    assert traces[1] / traces[0] == pytest.approx(4.0, rel=0.1)


def test_errors_of_many_registrations_match_their_covariance(rng: np.random.Generator):
    """With independent residuals on exact planes, scale 1 is exact."""
    surface = Surface(*scene(rng, ROOM, 4000))
    nees = []
    for _ in range(60):
        points, _ = scene(rng, ROOM, 60)
        inside = points * 0.95  # away from corners, where the neighbour may be on another wall
        inside[:, 2] = points[:, 2]
        source = seen_from(MOTION, points + 0.02 * rng.standard_normal(points.shape))
        found = register(surface, source, MOTION, EXACT)
        error = off(found.pose)
        nees.append(error @ np.linalg.solve(covariance_of(found.hessian, found.sigma_m, 1.0), error) / 6)
    assert 0.6 < np.mean(nees) < 1.5
