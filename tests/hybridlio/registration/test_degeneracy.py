"""Weak directions: smooth walls with noisy normals do not observe them, a few bushes do."""

import numpy as np
import pytest
from weak_scenes import (
    TRUTH,
    bend,
    between_trunks,
    bushes,
    error,
    ground,
    in_a_field,
    joined,
    noisy_surface,
    observe,
    off_by,
    scan,
)

from hybridlio.core import se3
from hybridlio.registration.surface import Surface


def test_bushes_all_around_leave_no_weak_direction(rng: np.random.Generator):
    where = rng.uniform(-25, 25, (200, 2))
    cloud = joined(ground(rng, 2000), bushes(rng, where, 12))
    observed = observe(noisy_surface(rng, cloud, 0.03), scan(rng, cloud), TRUTH)
    assert observed.weak_basis.shape == (6, 0)
    assert observed.degenerate.shape == (0, 6)


@pytest.mark.parametrize("ahead_m", [0.0, 0.4, -0.4], ids="{} m off".format)
def test_noisy_normals_of_smooth_walls_do_not_observe_the_direction_along_them(
    rng: np.random.Generator, ahead_m: float
):
    surface = noisy_surface(rng, bend(rng, 1e6, 4000), 0.03)
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
    surface = noisy_surface(rng, bend(rng, radius_m, 6000), 0.02)
    observed = observe(surface, se3.transform(TRUTH, scan(rng, bend(rng, radius_m, 3000))), np.eye(4))
    assert not observed.is_observed.any()
    turn = observed.weak_tangents[0, 2] / observed.weak_tangents[0, 3]
    assert turn == pytest.approx(1 / radius_m, rel=0.2)
    covariance = observed.covariance(1.0)
    assert covariance[2, 3] / covariance[3, 3] == pytest.approx(1 / radius_m, rel=0.2)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_a_vague_start_metres_away_is_corrected_by_distant_costs(rng: np.random.Generator):
    where = rng.uniform(-25, 25, (20, 2))
    surface = noisy_surface(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    near = observe(surface, source, off_by(1.6))
    far = observe(surface, source, off_by(1.6), vague=True)
    assert abs(error(far)[3]) < 0.7 < abs(error(near)[3])
    if not far.is_observed.all():
        sigma_m = float(np.sqrt(far.covariance(1.0)[3, 3]))
        assert abs(error(far)[3]) < 3 * sigma_m < 10


def test_distant_costs_of_an_endless_plane_observe_nothing(rng: np.random.Generator):
    """All positions on endless level ground are equally likely."""
    surface = noisy_surface(rng, ground(rng, 12000), 0.01)
    source = scan(rng, ground(rng, 3000))
    inside = source[np.abs(source).max(axis=1) < 20]
    observed = observe(surface, inside, off_by(0.5), vague=True)
    assert len(observed.degenerate) == 3
    assert (np.sqrt(np.diag(observed.covariance(1.0)))[3:5] > 1.5).all()


def rings(rng: np.random.Generator, cloud: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
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
    surface = noisy_surface(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    alone = off_by(1.0)
    assert observe(surface, source, off_by(0.3), 0.3, only_scan=alone).is_observed.all()


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
