"""Weak directions: smooth walls with noisy normals do not observe them, a few bushes do."""

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.registration.degeneracy import ObservedRegistration, RegistrationProblem, register_with_degeneracy
from hybridlio.registration.icp import RegistrationSettings
from hybridlio.registration.surface import Surface

SETTINGS = RegistrationSettings(threads=1)
TRUTH = se3.exp(np.array([0.002, -0.001, 0.01, 0.2, 0.1, 0.03]))
Cloud = tuple[np.ndarray, np.ndarray]


def observe(
    surface: Surface,
    source: np.ndarray,
    initial: np.ndarray,
    kernel_start_m: float = 0.0,
    *,
    vague: bool = False,
    only_scan: np.ndarray | None = None,
    dense: np.ndarray | None = None,
) -> ObservedRegistration:
    problem = RegistrationProblem(surface, source, SETTINGS, dense, only_scan)
    return register_with_degeneracy(problem, initial, kernel_start_m, vague)


def ground(rng: np.random.Generator, count: int) -> Cloud:
    xy = rng.uniform(-30, 30, (count, 2))
    return np.column_stack([xy, np.full(count, -1.7)]), np.tile([0.0, 0.0, 1.0], (count, 1))


def bushes(rng: np.random.Generator, where: np.ndarray, points: int) -> Cloud:
    angle, height = rng.uniform(-np.pi, np.pi, (2, len(where), points))
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    centres = np.concatenate([where, np.zeros((len(where), 1))], axis=1)[:, None]
    surface = centres + 0.8 * normals + np.stack([0 * height, 0 * height, height / 3], axis=-1)
    return surface.reshape(-1, 3), normals.reshape(-1, 3)


def bend(rng: np.random.Generator, radius_m: float, count: int) -> Cloud:
    """Two walls 4 m to either side of a circle that starts ahead at the origin, and the ground between."""
    angle = rng.uniform(-25, 25, count) / radius_m
    side = rng.choice([-1.0, 0.0, 1.0], count)
    left = np.where(side == 0, rng.uniform(-4, 4, count), 4 * side)
    height = np.where(side == 0, -1.7, rng.uniform(-1.7, 2, count))
    inward = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(count)])
    points = np.array([0.0, radius_m, 0.0]) - (radius_m - left)[:, None] * inward + height[:, None] * [0, 0, 1]
    return points, np.where(side[:, None] == 0, [0.0, 0.0, 1.0], inward)


def joined(*clouds: Cloud) -> Cloud:
    return np.concatenate([c[0] for c in clouds]), np.concatenate([c[1] for c in clouds])


def leaning(rng: np.random.Generator, cloud: Cloud, by: float) -> Surface:
    """A surface with noisy normals: a tilt of ``by`` radians, eight times that for one in twenty."""
    points, normals = cloud
    lean = by * np.where(rng.random(len(points)) < 0.05, 8.0, 1.0)
    normals = normals + lean[:, None] * rng.standard_normal(points.shape)
    return Surface(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), 1)


def scan(rng: np.random.Generator, cloud: Cloud, sigma_m: float = 0.02) -> np.ndarray:
    points = cloud[0] + sigma_m * rng.standard_normal(cloud[0].shape)
    return se3.transform(se3.inverse(TRUTH), points)


def off_by(ahead_m: float, left_m: float = 0.0) -> np.ndarray:
    return TRUTH @ se3.exp(np.array([0.0, 0.0, 0.0, ahead_m, left_m, 0.0]))


def error(observed: ObservedRegistration) -> np.ndarray:
    return se3.log(se3.between(TRUTH, observed.registration.pose))


def in_a_field(rng: np.random.Generator, ahead_m: float, left_m: float = 0.0) -> ObservedRegistration:
    where = rng.uniform(-25, 25, (20, 2))
    surface = leaning(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    return observe(surface, source, off_by(ahead_m, left_m), 0.3)


def test_bushes_all_around_leave_no_weak_direction(rng: np.random.Generator):
    where = rng.uniform(-25, 25, (200, 2))
    cloud = joined(ground(rng, 2000), bushes(rng, where, 12))
    observed = observe(leaning(rng, cloud, 0.03), scan(rng, cloud), TRUTH)
    assert observed.weak_basis.shape == (6, 0)
    assert observed.degenerate.shape == (0, 6)


@pytest.mark.parametrize("ahead_m", [0.0, 0.4, -0.4], ids="{} m off".format)
def test_noisy_normals_of_smooth_walls_do_not_observe_the_direction_along_them(
    rng: np.random.Generator, ahead_m: float
):
    surface = leaning(rng, bend(rng, 1e6, 4000), 0.03)
    observed = observe(surface, scan(rng, bend(rng, 1e6, 2000)), off_by(ahead_m))
    (direction,) = observed.degenerate
    assert abs(direction[3]) > 0.99
    assert error(observed)[3] == pytest.approx(ahead_m, abs=0.02)  # as initially
    sigmas = np.sqrt(np.diag(se3.rotate_covariance(observed.covariance(1.0), TRUTH)))  # in the frame of the walls
    assert sigmas[3] == pytest.approx(10.0, rel=0.02)
    assert (sigmas[[4, 5]] < 0.03).all()


@pytest.mark.parametrize("off", [(0.3, -0.2), (-0.2, 0.25)], ids=str)
def test_a_few_bushes_in_a_field_observe_all_directions(rng: np.random.Generator, off: tuple[float, float]):
    observed = in_a_field(rng, *off)
    assert observed.weak_basis.shape == (6, 3)  # ahead, sideways, yaw
    assert observed.is_observed.all()
    assert np.abs(error(observed)[3:5]).max() < 0.15
    assert (np.sqrt(np.diag(observed.covariance(6.0)))[3:5] < 0.3).all()


def test_errors_in_a_field_match_their_covariance(rng: np.random.Generator):
    nees = []
    for _ in range(25):
        observed = in_a_field(rng, *rng.uniform(-0.2, 0.2, 2))
        part = error(observed)[2:5]
        nees.append(part @ np.linalg.solve(observed.covariance(6.0)[2:5, 2:5], part) / 3)
    assert 0.05 < np.mean(nees) < 1.5


def test_a_start_outside_the_basin_of_attraction_still_converges(rng: np.random.Generator):
    assert np.abs(error(in_a_field(rng, 0.6))[3:5]).max() < 0.15


@pytest.mark.parametrize("radius_m", [60.0, -150.0])
def test_the_weak_direction_along_a_bend_includes_a_rotation(rng: np.random.Generator, radius_m: float):
    """An unknown arc length is an unknown yaw: 10 m on a radius of 60 m are a sixth of a radian."""
    surface = leaning(rng, bend(rng, radius_m, 6000), 0.02)
    observed = observe(surface, se3.transform(TRUTH, scan(rng, bend(rng, radius_m, 3000))), np.eye(4))
    assert not observed.is_observed.any()
    turn = observed.weak_tangents[0, 2] / observed.weak_tangents[0, 3]
    assert turn == pytest.approx(1 / radius_m, rel=0.2)
    covariance = observed.covariance(1.0)
    assert covariance[2, 3] / covariance[3, 3] == pytest.approx(1 / radius_m, rel=0.2)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_a_vague_start_metres_away_is_corrected_by_distant_costs(rng: np.random.Generator):
    where = rng.uniform(-25, 25, (20, 2))
    surface = leaning(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    near = observe(surface, source, off_by(1.6))
    far = observe(surface, source, off_by(1.6), vague=True)
    assert abs(error(far)[3]) < 0.7 < abs(error(near)[3])
    if not far.is_observed.all():
        sigma_m = float(np.sqrt(far.covariance(1.0)[3, 3]))
        assert abs(error(far)[3]) < 3 * sigma_m < 10


def test_distant_costs_of_an_endless_plane_observe_nothing(rng: np.random.Generator):
    """All positions on endless level ground are equally likely."""
    surface = leaning(rng, ground(rng, 12000), 0.01)
    source = scan(rng, ground(rng, 3000))
    inside = source[np.abs(source).max(axis=1) < 20]
    observed = observe(surface, inside, off_by(0.5), vague=True)
    assert len(observed.degenerate) == 3
    assert (np.sqrt(np.diag(observed.covariance(1.0)))[3:5] > 1.5).all()


def rings(rng: np.random.Generator, cloud: Cloud) -> np.ndarray:
    """A scan with the same range errors as every other scan of the cloud: a lidar's own pattern."""
    return cloud[0] + 0.04 * np.sin(3 * cloud[0][:, :1]) * cloud[1] + 0.005 * rng.standard_normal(cloud[0].shape)


def test_a_lidars_own_pattern_is_ignored_next_to_the_only_other_scan(rng: np.random.Generator):
    walls = bend(rng, 1e6, 6000)
    surface, source = Surface(rings(rng, walls), walls[1], 1), rings(rng, walls)
    start = se3.exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0]))
    deceived = observe(surface, source, start, vague=True)
    observed = observe(surface, source, start, vague=True, only_scan=np.eye(4))
    assert deceived.is_observed.all()
    assert abs(deceived.registration.pose[0, 3]) < 0.05
    assert not observed.is_observed.any()
    assert np.sqrt(observed.covariance(1.0)[3, 3]) > 1.0


def test_bushes_are_observed_far_from_the_only_other_scan(rng: np.random.Generator):
    where = rng.uniform(-25, 25, (20, 2))
    surface = leaning(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    alone = off_by(1.0)
    assert observe(surface, source, off_by(0.3), 0.3, only_scan=alone).is_observed.all()


def tree_points(rng: np.random.Generator, where: np.ndarray, points: int) -> np.ndarray:
    """Points on trunks 20 cm thick and three metres high, which make no planes."""
    angle, height = rng.uniform(-np.pi, np.pi, (2, len(where), points))
    around = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([where[:, None] + around, height[..., None] / 2], axis=-1).reshape(-1, 3)


def between_trunks(rng: np.random.Generator) -> tuple[Surface, np.ndarray, np.ndarray]:
    """Ground and trunks with arbitrary normals; the points of a scan that are registered, and all its points."""
    where, (flat, upright) = rng.uniform(-25, 25, (20, 2)), ground(rng, 8000)
    trunks = tree_points(rng, where, 100)
    lean = rng.standard_normal(trunks.shape)
    normals = np.concatenate([upright, lean / np.linalg.norm(lean, axis=1, keepdims=True)])
    weights = np.concatenate([np.ones(len(flat)), np.full(len(trunks), 0.6)])
    surface = Surface(np.concatenate([flat, trunks]), normals, 1, weights)
    seen = np.concatenate([ground(rng, 7000)[0], tree_points(rng, where, 30)])
    points = scan(rng, (seen, seen), 0.01)
    return surface, np.concatenate([points[:7000], points[7000::2]]), points


def test_points_of_trunks_determine_the_position_to_two_centimetres(rng: np.random.Generator):
    surface, source, points = between_trunks(rng)
    observed = observe(surface, source, off_by(0.1, -0.1), 0.1, dense=points)
    assert observed.weak_basis.shape == (6, 3)
    assert observed.is_observed.all()
    assert np.abs(error(observed)[3:5]).max() < 0.02
    assert np.abs(error(observed)[2]) < 1e-3


def test_ambiguous_point_matches_leave_the_result_of_the_parabola(rng: np.random.Generator):
    """Two starts end at different poses, so the parabola's minimum and its larger sigma are kept."""
    surface, source, points = between_trunks(rng)
    start, kernel_m = off_by(0.1, -0.1), 0.1
    anywhere = np.concatenate([points[:7000], rng.uniform([-25, -25, -1], [25, 25, 1], (600, 3))])
    lost = observe(surface, source, start, kernel_m, dense=anywhere)
    close = observe(surface, source, start, kernel_m, dense=points)
    assert lost.is_observed.all()
    assert np.abs(error(lost)[3:5]).max() < 0.1
    sigmas, close_sigmas = (np.sqrt(np.diag(one.covariance(1.0)))[3:5] for one in (lost, close))
    assert (sigmas > 2 * close_sigmas).all()
