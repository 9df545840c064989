"""Whether a relative pose and the IMU agree within their covariances, and what becomes of one that does not.

The test is the normalised innovation squared (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking
and Navigation" (2001), §5.4.2): the difference of the two under the sum of their covariances, χ² with six degrees of
freedom where both tell the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M

Verdict = Literal["untested", "agrees", "down-weighted", "rejected", "relocated", "trusted again"]

GATE = 27.86  # χ², six degrees of freedom: one in ten thousand lies above
GROSS = 10 * GATE  # no covariance that is only somewhat too small explains this
MOST_REJECTED = 5  # in a row; then it may be the IMU that is wrong
START_STEPS = 10  # speed, tilt and biases are still being found from the scans


@dataclass(frozen=True)
class Agreement:
    """What came of the comparison at one step.

    Attributes:
        verdict: ``untested`` where there is nothing to compare, or the IMU does not know its speed and tilt yet;
            ``agrees``; ``down-weighted``, with a covariance just large enough to agree; ``rejected``, so that the IMU
            bridges; ``relocated``, bridged too, but the residual source goes on from where it found the scan, after too
            many rejections; ``trusted again``, taken as it is, after that.
        chi2: the difference under both covariances; None where untested.
    """

    verdict: Verdict
    chi2: float | None = None


UNTESTED = Agreement("untested")


def chi2_of(measured: RelativePose, predicted: RelativePose, times: float = 1.0) -> float:
    """The squared difference under the sum of the covariances, the measured one's taken ``times`` as large.

    The difference is ``Log(measured⁻¹·predicted)``; so small that both covariances hold in one tangent space.
    """
    return _chi2(_difference(measured, predicted), times * measured.covariance + predicted.covariance)


def widening(measured: RelativePose, predicted: RelativePose, chi2: float = GATE) -> float:
    """By how much the measured covariance must grow for the two to differ by ``chi2`` only; 1 where they do already.

    Solved by bisection in its logarithm: the difference falls as the covariance grows, towards zero.
    """
    error = _difference(measured, predicted)

    def is_too_far(log_times: float) -> bool:
        return _chi2(error, np.exp(log_times) * measured.covariance + predicted.covariance) > chi2

    low, high = 0.0, 1.0
    if not is_too_far(low):
        return 1.0
    while is_too_far(high):
        low, high = high, 2 * high
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if is_too_far(middle) else (low, middle)
    return float(np.exp(high))


def _difference(measured: RelativePose, predicted: RelativePose) -> Array:
    return se3.log(se3.between(measured.pose, predicted.pose))


def _chi2(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


class Witness:
    """Compares each step's relative pose with what the IMU predicted, and remembers how often it was rejected.

    After :data:`MOST_REJECTED` rejections in a row it may be the map that was lost: the next scan's place in it is a
    jump and no motion, and those after it agree again. Where they do not, it may be the IMU that is wrong, and they are
    taken as they are until one agrees: the graph can then learn its bias or speed.
    """

    def __init__(self) -> None:
        self._steps = 0
        self._rejected = 0

    def judge(
        self, measured: RelativePose, predicted: RelativePose | None, bridge: RelativePose
    ) -> tuple[RelativePose, Agreement]:
        """The relative pose for the graph, and how it compares.

        Args:
            measured: of the residual source.
            predicted: by the IMU; None where it cannot say.
            bridge: what stands in for a rejected one.
        """
        self._steps += 1
        if self._steps <= START_STEPS or not _comparable(measured, predicted):
            return measured, UNTESTED
        assert predicted is not None
        chi2 = chi2_of(measured, predicted)
        if chi2 <= GATE:
            self._rejected = 0
            return measured, Agreement("agrees", chi2)
        if self._rejected > MOST_REJECTED:
            return measured, Agreement("trusted again", chi2)
        if chi2 <= GROSS:
            return measured.wider(widening(measured, predicted)), Agreement("down-weighted", chi2)
        self._rejected += 1
        verdict: Verdict = "relocated" if self._rejected > MOST_REJECTED else "rejected"
        details = {**measured.details, "chi2": chi2}
        return replace(bridge, ok=False, drift=None, keyframes=(), details=details), Agreement(verdict, chi2)


def _comparable(measured: RelativePose, predicted: RelativePose | None) -> bool:
    if predicted is None or not predicted.ok or not measured.ok or measured.from_imu:
        return False
    return predicted.translation_sigma_m <= UNKNOWN_TRANSLATION_SIGMA_M
