"""The gate's limits, counted in steps and standard deviations instead of read from its constants."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.sources.gate.innovation_gate import InnovationGate

COVARIANCE = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2)
IMU = RelativePose(np.eye(4), COVARIANCE, "preintegration", from_imu=True)


def measured(sigmas: float) -> RelativePose:
    """A step ahead that is ``sigmas`` standard deviations of the innovation from the prediction."""
    return RelativePose(se3.exp(np.array([0, 0, 0, sigmas * np.sqrt(2) * 0.01, 0, 0])), COVARIANCE, "test")


def verdicts(sigmas: float, steps: int, gate: InnovationGate | None = None) -> list[str]:
    gate = gate or InnovationGate()
    return [gate.apply(measured(sigmas), IMU, IMU, 0.1)[1].verdict for _ in range(steps)]


def test_the_first_second_or_so_is_not_gated():
    """At 10 Hz; shorter, and speed and tilt are unknown; longer, and wrong scans pass at the start."""
    assert 5 <= verdicts(100.0, 200).count("untested") <= 20


@pytest.mark.parametrize(
    ("sigmas", "verdict"),
    [(3.5, "accepted"), (7.0, "down-weighted"), (12.0, "down-weighted"), (25.0, "rejected")],
)
def test_the_verdict_follows_the_number_of_sigmas(sigmas: float, verdict: str):
    gate = InnovationGate()
    verdicts(0.0, 25, gate)
    assert verdicts(sigmas, 1, gate) == [verdict]


def test_rejections_in_a_row_end_within_a_second():
    """At 10 Hz. A few rejections are needed while a lorry passes; the IMU bridges a second with decimetres of error."""
    gate = InnovationGate()
    verdicts(0.0, 25, gate)
    found = verdicts(50.0, 60, gate)
    assert 3 <= found.count("rejected") <= 10
    assert found[-1] == "IMU left out"
