"""Trust in the IMU: noise that follows the innovations, and samples that are left out and come back."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.sensors import ImuNoise
from hybridlio.sources.gate.gate_result import GateResult
from hybridlio.sources.gate.imu_trust import ImuTrust

STEP_NS = 100_000_000
AGREES, OUT = GateResult("accepted", 6.0, (1.0, 1.0)), GateResult("IMU left out", 100.0)
BACK = GateResult("IMU left out", 6.0)


def steps_out(trust: ImuTrust, begin: int) -> int:
    """Number of steps that the samples are left out after one contradiction."""
    trust.learn(OUT, begin * STEP_NS)
    count = 0
    while trust.left_out:
        count += 1
        trust.learn(BACK, (begin + count) * STEP_NS)
    return count


def test_an_imu_comes_back_after_a_second_of_agreement():
    assert 5 <= steps_out(ImuTrust(ImuNoise()), 100) <= 20


def test_contradictions_prolong_the_time_in_which_it_is_left_out():
    trust = ImuTrust(ImuNoise())
    for k in range(50):
        trust.learn(OUT, (100 + k) * STEP_NS)
        assert trust.left_out


def test_with_each_relapse_it_stays_out_twice_as_long_but_not_for_good():
    trust, k, counts = ImuTrust(ImuNoise()), 100, []
    for _ in range(10):
        counts.append(steps_out(trust, k))
        k += counts[-1] + 3
    assert counts[1] == pytest.approx(2 * counts[0], abs=1)
    assert counts[2] == pytest.approx(4 * counts[0], abs=2)
    assert 300 <= counts[-1] <= 1200  # half a minute to two


def test_a_long_time_in_agreement_is_a_fresh_start():
    trust = ImuTrust(ImuNoise())
    first, k = steps_out(trust, 100), 200
    for k in range(200, 1200):
        trust.learn(AGREES, k * STEP_NS)
    assert steps_out(trust, k + 1) == first


def test_the_noise_grows_until_it_explains_the_innovations():
    """The parts of a true noise ten times the stated one fall as the believed noise grows."""
    rng, trust, stated = np.random.default_rng(0), ImuTrust(ImuNoise()), ImuNoise()
    for k in range(400):
        scale = trust.noise.gyro_rad_s_sqrt_hz / stated.gyro_rad_s_sqrt_hz
        parts = tuple(float(x) for x in rng.chisquare(3, 2) / 3 * np.array([100.0, 1.0]) / np.array([scale**2, 1.0]))
        trust.learn(GateResult("accepted", 0.0, (parts[0], parts[1])), k * STEP_NS)
    assert trust.noise.gyro_rad_s_sqrt_hz == pytest.approx(10 * stated.gyro_rad_s_sqrt_hz, rel=0.5)
    assert trust.noise.accel_m_s2_sqrt_hz < 2 * stated.accel_m_s2_sqrt_hz


def test_noise_grows_within_seconds_and_shrinks_again():
    trust, stated, k = ImuTrust(ImuNoise()), ImuNoise(), 0
    while trust.noise.accel_m_s2_sqrt_hz < 3 * stated.accel_m_s2_sqrt_hz:
        k += 1
        trust.learn(GateResult("accepted", 20.0, (1.0, 9.0)), k * STEP_NS)
    assert 3 <= k <= 50
    for j in range(200):
        trust.learn(GateResult("accepted", 1.0, (0.3, 0.3)), (k + j) * STEP_NS)
    assert trust.noise == stated


def test_less_noise_than_stated_is_never_believed():
    trust = ImuTrust(ImuNoise())
    for k in range(100):
        trust.learn(GateResult("accepted", 0.1, (0.01, 0.01)), k * STEP_NS)
    assert trust.noise == ImuNoise()
