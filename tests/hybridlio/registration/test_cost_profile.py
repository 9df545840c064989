"""Costs beside a pose: the parabola's minimum and significance, and likelihoods farther off, against known truths."""

import numpy as np
import pytest

from hybridlio.registration.cost_profile import OFFSETS_M, parabola_minimum, weigh_offsets

STEP_M = 0.5
EVERYWHERE = np.ones(9, bool)


def rises(rng: np.random.Generator, ratio: float, count: int = 400) -> np.ndarray:
    """Rises of independent points whose sum is ``ratio`` times the square root of their sum of squares."""
    noise = rng.standard_normal(count)
    noise -= noise.mean()
    shift = ratio * np.sqrt(noise @ noise / (count - ratio**2) / count)
    return noise + shift


def parabola(at_m: float, noise: float, rng: np.random.Generator, curvature: float = 0.02) -> list[np.ndarray]:
    """Rises at −0.5 m and 0.5 m of 300 points whose cost is a noisy parabola with its minimum at ``at_m``."""
    return [curvature * ((t - at_m) ** 2 - at_m**2) + noise * rng.standard_normal(300) for t in (-STEP_M, STEP_M)]


@pytest.mark.parametrize("at_m", [-0.3, 0.0, 0.17])
def test_the_parabolas_minimum_is_found(rng: np.random.Generator, at_m: float):
    offset_m, sigma_m = parabola_minimum(*parabola(at_m, 1e-4, rng, curvature=1.0))
    assert offset_m == pytest.approx(at_m, abs=1e-3)
    assert np.isfinite(sigma_m)


def test_the_minimums_standard_deviation_is_that_of_its_errors(rng: np.random.Generator):
    found = np.array([parabola_minimum(*parabola(0.1, 0.01, rng)) for _ in range(300)])
    assert np.isfinite(found).all()
    errors = (found[:, 0] - 0.1) / found[:, 1]
    # the scatter includes the rises' common part, so sigma is somewhat large
    assert 0.4 < errors.std() < 1.2


@pytest.mark.parametrize(("ratio", "is_observed"), [(3.5, False), (6.0, True)], ids=["smooth walls", "field"])
def test_rises_of_smooth_walls_are_noise_and_those_of_a_field_are_not(
    rng: np.random.Generator, ratio: float, is_observed: bool
):
    """The largest ratio of rise to scatter seen between smooth walls, and the smallest in open fields."""
    back, ahead = np.split(rises(rng, ratio), 2)
    assert np.isfinite(parabola_minimum(back, ahead)[1]) == is_observed


def test_an_unobserved_direction_is_followed_only_where_costs_fall_clearly(rng: np.random.Generator):
    falling, level = rises(rng, -6.0), rises(rng, 0.5)
    assert parabola_minimum(level, falling) == (STEP_M, np.inf)
    assert parabola_minimum(falling, level) == (-STEP_M, np.inf)
    assert parabola_minimum(level, level) == (0.0, np.inf)


def valley(at_m: float, sigma_m: float, temperature: float = 1.5) -> list[np.ndarray]:
    """Rises whose sums over scatter make a normal likelihood of this mean and standard deviation, by the definition."""
    heights = temperature * (OFFSETS_M - at_m) ** 2 / (2 * sigma_m**2)
    return [np.r_[np.full(1600, h / 1600) + np.tile([1, -1], 800) / 40] for h in heights]  # scatter 1


@pytest.mark.parametrize("at_m", [0.0, 0.6, -0.8])
def test_a_normal_likelihood_gives_its_mean_and_twice_its_variance(at_m: float):
    """A rise of 1.5 scatters is e times less likely; the factor 2 is for errors shared by successive scans."""
    offset_m, sigma_m = weigh_offsets(valley(at_m, 0.5), EVERYWHERE)
    assert offset_m == pytest.approx(at_m, abs=0.2)
    assert sigma_m == pytest.approx(np.sqrt(2) * 0.5, rel=0.25)


def test_a_wide_minimum_is_used_unless_it_is_wider_than_the_search():
    offset_m, sigma_m = weigh_offsets(valley(0.5, 1.5), EVERYWHERE)
    assert 0.1 < offset_m < 1.5
    assert 1.0 < sigma_m < 5.0
    assert weigh_offsets(valley(0.5, 30.0), EVERYWHERE) == (0.0, 10.0)


def test_a_low_cost_where_it_is_not_trusted_is_replaced_by_those_around(rng: np.random.Generator):
    """Around the only other scan a lidar's pattern matches itself."""
    deceptive = valley(1.0, 0.6)
    deceptive[4] = np.full(1600, -5.0 / 1600) + np.tile([1, -1], 800) / 40
    trusted = EVERYWHERE.copy()
    trusted[4] = False
    believed, _ = weigh_offsets(deceptive, EVERYWHERE)
    offset_m, _ = weigh_offsets(deceptive, trusted)
    assert abs(believed) < 0.5 < offset_m
    assert weigh_offsets(deceptive, np.zeros(9, bool)) == (0.0, 10.0)
