"""The search for an unknown motion: it finds the right candidate, in spite of outliers and small overlaps."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import ROOM, scene, seen_from, wall

from hybridlio.core import se3
from hybridlio.registration import motion_search
from hybridlio.registration.motion_search import best_start, fits_better, motions
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

SETTINGS = RegistrationSettings(threads=1)
TRUTH = se3.exp(np.array([0.0, 0.0, 0.02, 1.4, 0.0, 0.0]))


def ahead(x_m: float) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, 0.0, x_m, 0.0, 0.0]))


def error_m(pose: np.ndarray) -> float:
    return float(np.linalg.norm(se3.between(TRUTH, pose)[:3, 3]))


def room(rng: np.random.Generator, outliers: float = 0.0) -> tuple[Surface, np.ndarray]:
    """A room, and a scan of it with a share of points that belong to something else."""
    surface = Surface(*scene(rng, ROOM, 3000), 1)
    points, _ = scene(rng, ROOM, 800)
    wrong = rng.random(len(points)) < outliers
    points[wrong] = rng.uniform([-9, -7, -1.5], [9, 7, 2.5], (wrong.sum(), 3))
    return surface, seen_from(TRUTH, points + 0.02 * rng.standard_normal(points.shape))


def test_motions_are_all_speeds_with_all_rates():
    poses = motions((0.0, 10.0), (0.0, 90.0), 0.1)
    np.testing.assert_allclose([pose[0, 3] for pose in poses[:3]], [0.0, 0.0, 1.0], atol=1e-12)
    assert len(poses) == 4
    np.testing.assert_allclose(se3.log(poses[3]), [0, 0, np.pi / 20, 1.0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_nearest_of_many_starts_is_found_and_refined(rng: np.random.Generator, outliers: float):
    surface, source = room(rng, outliers)
    starts = [
        ahead(x) @ se3.exp(np.array([0, 0, yaw, 0, 0, 0])) for x in np.arange(-5, 6, 0.6) for yaw in (-0.2, 0, 0.2)
    ]
    assert error_m(best_start(surface, source, source, starts, SETTINGS)) < 0.02


def test_a_small_overlap_does_not_win_by_its_low_cost(rng: np.random.Generator):
    """At a start 40 m too high only the floor of the scan overlaps the map, without any error."""
    shelf, normals = wall(rng, (-12, -10, 38.0), (24, 0, 0), (0, 20, 0), 3000)
    surface, source = room(rng)
    surface = surface.extended(shelf, normals, 1)
    curtains = rng.uniform([9.3, -6, -0.5], [9.3, 6, 2.0], (8000, 3))  # that the map does not have, near two walls
    curtains[::2, 0] *= -1
    source = np.concatenate([source, seen_from(TRUTH, curtains)])
    starts = [TRUTH @ ahead(0.2), TRUTH @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 40.0]))]
    assert error_m(best_start(surface, source, source, starts, SETTINGS)) < 0.05


def test_the_most_matches_do_not_win_in_spite_of_a_high_cost(rng: np.random.Generator):
    """Forty metres up there is a thicket, in which every point of the scan has some neighbour."""
    thicket, normals = rng.uniform([-13, -11, 37], [13, 11, 44], (12_000, 3)), rng.standard_normal((12_000, 3))
    surface, source = room(rng)
    surface = surface.extended(thicket, normals / np.linalg.norm(normals, axis=1, keepdims=True), 1)
    moved = rng.uniform([-5, -4, 0.0], [5, 4, 0.5], (400, 3))  # in the middle of the room, away from all walls
    source = np.concatenate([source, seen_from(TRUTH, moved)])
    starts = [TRUTH @ ahead(0.2), TRUTH @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 40.0]))]
    assert error_m(best_start(surface, source, source, starts, SETTINGS)) < 0.05


def test_many_starts_are_compared_by_few_points_and_a_dozen_by_all(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
):
    surface, source = room(rng)
    judged, refined = [], []
    fit_at, register = motion_search.fit_at, motion_search.register
    monkeypatch.setattr(
        motion_search, "fit_at", lambda s, points, *a: judged.append(len(points)) or fit_at(s, points, *a)
    )
    monkeypatch.setattr(motion_search, "register", lambda *a: refined.append(1) or register(*a))
    starts = [TRUTH @ ahead(x) for x in np.linspace(-0.5, 0.5, 40)]
    best_start(surface, source, source, starts, SETTINGS)
    assert 8 <= len(refined) <= 20
    assert max(judged[:40]) < len(source) / 4
    assert min(judged[:40]) > 100
    assert judged[40:] == [len(source)] * len(refined)


def test_a_few_points_decide_between_two_poses(rng: np.random.Generator):
    surface, source = room(rng)
    assert fits_better(surface, source, TRUTH, TRUTH @ ahead(0.3), 0.3, 1)
    assert not fits_better(surface, source, TRUTH @ ahead(0.3), TRUTH, 0.3, 1)
