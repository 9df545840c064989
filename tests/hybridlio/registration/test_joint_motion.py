"""One smooth motion through several sparse scans, found from their points alone."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.joint_motion import JointPoints, JointProblem
from hybridlio.registration.settings import RegistrationSettings

SCANS, POINTS, NOISE_M, SCALE = 5, 1200, 0.02, 10.0
HALF_ROOM_M = np.array([6.0, 4.0, 2.0])
MOTION = np.r_[0.05, -0.03, 0.1, 1.2, -0.7, 0.3, 0.5, -0.4, 0.2]
PRIOR = np.r_[np.full(3, 0.3), np.full(3, 20.0), np.full(3, 2.0)]


def wall_points(rng: np.random.Generator) -> Array:
    """Return points scattered over the walls, floor and ceiling of a room about the origin, and of a box in it."""
    out = rng.uniform(-1, 1, (POINTS, 3))
    face = rng.integers(0, 3, POINTS)
    out[np.arange(POINTS), face] = np.sign(out[np.arange(POINTS), face])
    box = rng.random(POINTS) < 0.2
    return np.where(box[:, None], np.array([0.5, 1.0, -1.0]) + 0.5 * out, HALF_ROOM_M * out)


def recorded(rng: np.random.Generator, motion: Array = MOTION) -> JointPoints:
    """Return points as a lidar at rest at the origin would place them, which in truth moves by ``motion``."""
    parts = []
    for k in range(SCANS):
        world = wall_points(rng) + rng.normal(0, NOISE_M, (POINTS, 3))
        times = 0.1 * (k + rng.random(POINTS))[:, None]
        turned = se3.so3_exp(-times * motion[:3])
        there = world - times * motion[3:6] - times**2 / 2 * motion[6:]
        points = np.einsum("nij,nj->ni", turned, there)
        parts.append(JointPoints(points, np.zeros_like(points), times[:, 0], np.full(POINTS, k)))
    return JointPoints.concatenate(parts)


def problem(points: JointPoints, stride: int = 1) -> JointProblem:
    return JointProblem(points, RegistrationSettings(), PRIOR, SCALE, stride)


@pytest.mark.parametrize("stride", [1, 3])
def test_the_motion_is_found_from_rest_within_its_covariance(rng: np.random.Generator, stride: int) -> None:
    found = problem(recorded(rng), stride).solve(np.zeros(9), 1.0, 12)
    error = found.motion - MOTION
    at_end_m = 0.5 * error[3:6] + 0.125 * error[6:]
    assert np.linalg.norm(at_end_m) < 0.02
    assert 0.5 * np.linalg.norm(error[:3]) < 5e-3
    assert error @ np.linalg.solve(found.covariance, error) / 9 < 3
    assert found.matched > 0.9


def test_displaced_points_lie_where_they_were_measured(rng: np.random.Generator) -> None:
    moved = recorded(rng).moved(MOTION)
    from_walls = np.abs(np.abs(moved) - HALF_ROOM_M).min(axis=1)
    assert np.median(from_walls) < 2 * NOISE_M


def test_a_false_motion_costs_significantly_more(rng: np.random.Generator) -> None:
    given = problem(recorded(rng))
    right, false = given.solve(MOTION, 0.1, 12), given.solve(MOTION + np.r_[np.zeros(3), 3, 0, 0, np.zeros(3)], 0.1, 0)
    assert false.rise_over_scatter(right) > 10
    assert right.rise_over_scatter(right) == 0


def test_a_direction_without_structure_keeps_its_prior(rng: np.random.Generator) -> None:
    parts = recorded(rng)
    on_floor = np.abs(parts.moved(MOTION)[:, 2] + HALF_ROOM_M[2]) < 4 * NOISE_M
    floor = JointPoints(parts.points[on_floor], parts.centres[on_floor], parts.times_s[on_floor], parts.scans[on_floor])
    found = problem(floor).solve(np.zeros(9), 1.0, 12)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[3:5].min() > 10 * sigmas[5]
