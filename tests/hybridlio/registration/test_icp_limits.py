"""Registration's limits: when it has converged, when it matches again, and which neighbours it matches."""

import numpy as np
import pytest
from rooms import FLOOR, ROOM, scene, seen_from, wall

from hybridlio.core import se3
from hybridlio.registration.icp import fit_at, register
from hybridlio.registration.point_to_point import MixedNeighbours
from hybridlio.registration.results import Registration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

DEFAULTS = RegistrationSettings(threads=1)
MOTION = se3.exp(np.array([0.01, -0.02, 0.05, 0.3, -0.2, 0.1]))


@pytest.fixture
def matched_at(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Poses at which registrations match."""
    poses: list[np.ndarray] = []
    matches = MixedNeighbours.matches

    def recorded(self, pose, max_distance_m):
        poses.append(pose)
        return matches(self, pose, max_distance_m)

    monkeypatch.setattr(MixedNeighbours, "matches", recorded)
    return poses


def noisy_room(seed: int) -> tuple[Surface, np.ndarray]:
    rng = np.random.default_rng(seed)
    surface = Surface(*scene(rng, ROOM, 4000), 1)
    points, _ = scene(rng, ROOM, 500)
    return surface, seen_from(MOTION, points + 0.03 * rng.standard_normal(points.shape))


def change(one: Registration, other: Registration) -> np.ndarray:
    return np.abs(se3.log(se3.between(one.pose, other.pose)))


@pytest.mark.parametrize("seed", range(4))
def test_a_registration_that_has_converged_stays_where_it_is(seed: int):
    """To a millimetre at 50 m and half a millimetre, in a number of steps that leaves time for other scans."""
    surface, source = noisy_room(seed)
    found = register(surface, source, np.eye(4), DEFAULTS, kernel_start_m=1.0)
    assert found.converged
    assert found.iterations <= 12
    moved = change(found, register(surface, source, found.pose, DEFAULTS))
    assert moved[:3].max() < 1.5e-5
    assert moved[3:].max() < 5e-4


def test_a_slow_convergence_is_followed_to_the_end(rng: np.random.Generator):
    """With noise as large as the kernel, steps shrink slowly; one of centimetres is not the last."""
    points, normals = scene(rng, ROOM, 4000)
    surface, source = Surface(10 * points, normals, 1), 10 * points[::5] + 0.1 * rng.standard_normal((4000, 3))
    found = register(surface, source, se3.exp(np.array([0, 0, 0, 0.3, 0.2, 0.1])), DEFAULTS)
    assert change(found, register(surface, source, found.pose, DEFAULTS))[3:].max() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_a_pose_that_has_rotated_is_matched_again(seed: int):
    surface, source = noisy_room(seed)
    start = MOTION @ se3.exp(np.array([0, 0, 0.1, 0, 0, 0]))
    found = register(surface, source, start, DEFAULTS, kernel_start_m=0.3)
    assert change(found, register(surface, source, found.pose, DEFAULTS))[:3].max() < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_a_pose_that_has_been_translated_is_matched_again(seed: int):
    """The points are the surface's own, so that after the last matching nothing is left."""
    points, normals = scene(np.random.default_rng(seed), ROOM, 4000)
    start = se3.exp(np.array([0, 0, 0, 0.08, 0.06, -0.08]))
    found = register(Surface(points, normals, 1), points[::5], start, DEFAULTS)
    assert np.abs(se3.log(found.pose)[3:]).max() < 1e-5


def test_matches_serve_several_steps(matched_at: list[np.ndarray]):
    steps = 0
    for seed in range(4):
        surface, source = noisy_room(seed)
        steps += register(surface, source, MOTION @ se3.exp(np.full(6, 0.002)), DEFAULTS).iterations
    assert len(matched_at) < 0.7 * steps


def test_after_a_long_step_points_are_matched_at_once(matched_at: list[np.ndarray]):
    """Most matches made 40 cm away are wrong; more steps by them lead nowhere."""
    surface, source = noisy_room(0)
    one_step = register(surface, source, np.eye(4), RegistrationSettings(threads=1, max_iterations=1))
    matched_at.clear()
    register(surface, source, np.eye(4), DEFAULTS)
    np.testing.assert_allclose(matched_at[1], one_step.pose, atol=1e-9)


def test_a_fit_counts_neighbours_within_a_few_kernels(rng: np.random.Generator):
    points, normals = wall(rng, *FLOOR)
    surface = Surface(points, normals, 1)
    for height_m, matched in ((0.2, 1.0), (1.0, 0.0)):
        assert fit_at(surface, points + np.array([0, 0, height_m]), np.eye(4), 0.1, 1).matched == matched


def test_objects_are_matched_half_a_metre_from_a_surface_and_not_two(rng: np.random.Generator):
    points, normals = scene(rng, ROOM, 4000)
    others = rng.uniform([-6, -5, -1.6], [6, 5, -1.4], (500, 3))  # above the floor, which is at −2 m
    for lift_m, matched in ((0.0, 1.0), (1.8, 0.8)):
        source = np.concatenate([points[::10], others + np.array([0, 0, lift_m])])
        found = register(Surface(points, normals, 1), source, np.eye(4), DEFAULTS)
        assert found.matched == pytest.approx(matched, abs=0.01)
