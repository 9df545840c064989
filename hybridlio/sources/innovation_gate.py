"""The innovation gate: compares each relative pose with the IMU's prediction and limits the effect of wrong ones.

The test statistic is the normalised innovation squared (NIS): the squared difference of measurement and prediction
under the sum of their covariances (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation" (2001), §5.4.2). Where both covariances are right it is χ² distributed with six degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M

Verdict = Literal["untested", "accepted", "down-weighted", "rejected", "relocated", "trusted again"]

GATE_NIS = 27.86  # 99.99 % quantile of χ² with six degrees of freedom: one right measurement in 10,000 is above
GROSS_NIS = 10 * GATE_NIS  # a right pose stays below even with covariances 10 times too small; above, the pose is wrong
MAX_REJECTIONS = 5  # in a row: half a second at 10 Hz; the IMU bridges so long to a few decimetres
WARM_UP_STEPS = 10  # one second at 10 Hz, in which speed, tilt and biases are still being found from the scans
_BISECTIONS = 40  # halves the bracket to 1e-12 of its width, below any effect on a covariance


@dataclass(frozen=True)
class GateResult:
    """Outcome of the gate at one step.

    Attributes:
        verdict: what was done with the relative pose:

            * ``untested``: passed on; there is no usable prediction, or the run is in its first steps.
            * ``accepted``: passed on; the innovation is within the gate.
            * ``down-weighted``: passed on with a covariance inflated until the innovation is at the gate.
            * ``rejected``: replaced by the bridge; the residual source is asked to take the scan back.
            * ``relocated``: replaced by the bridge after too many rejections in a row, but the residual source
              continues from where it found the scan.
            * ``trusted again``: passed on although outside the gate, after a relocation that did not help.
        nis: normalised innovation squared; None where untested.
    """

    verdict: Verdict
    nis: float | None = None


UNTESTED = GateResult("untested")


def normalised_innovation_squared(measured: RelativePose, predicted: RelativePose) -> float:
    """Return the squared innovation ``Log(measured⁻¹·predicted)`` under the sum of both covariances.

    The innovation is taken to be so small that both covariances hold in one tangent space.
    """
    return _nis(_innovation(measured, predicted), measured.covariance + predicted.covariance)


def inflation_to_gate(measured: RelativePose, predicted: RelativePose, gate_nis: float = GATE_NIS) -> float:
    """Return the factor on the measured covariance that brings the NIS down to the gate; 1 where it is within already.

    Solved by bisection in the factor's logarithm: the NIS falls monotonically, towards zero, as the factor grows.
    """
    innovation = _innovation(measured, predicted)

    def is_outside(log_factor: float) -> bool:
        return _nis(innovation, np.exp(log_factor) * measured.covariance + predicted.covariance) > gate_nis

    low, high = 0.0, 1.0
    if not is_outside(low):
        return 1.0
    while is_outside(high):
        low, high = high, 2 * high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if is_outside(middle) else (low, middle)
    return float(np.exp(high))


def _innovation(measured: RelativePose, predicted: RelativePose) -> Array:
    return se3.log(se3.between(measured.pose, predicted.pose))


def _nis(innovation: Array, covariance: Array) -> float:
    return float(innovation @ np.linalg.solve(covariance, innovation))


class InnovationGate:
    """Tests each step's relative pose against the IMU's prediction and counts rejections in a row.

    After :data:`MAX_REJECTIONS` rejections, the position in the map may be lost. The next relative pose is then a jump
    in the map, not a motion, and is rejected too; those after it agree with the IMU again. If they do not, the IMU may
    be wrong: relative poses then pass until one is within the gate, so that the graph can correct the IMU's biases or
    the speed.
    """

    def __init__(self) -> None:
        self._steps = 0
        self._rejected_in_a_row = 0

    def apply(
        self, measured: RelativePose, predicted: RelativePose | None, bridge: RelativePose
    ) -> tuple[RelativePose, GateResult]:
        """Return the relative pose that the backend is to use, and the gate's result.

        Args:
            measured: the residual source's relative pose.
            predicted: the IMU's; None where there is no inertial data.
            bridge: the relative pose that replaces a rejected one.
        """
        self._steps += 1
        if predicted is None or self._steps <= WARM_UP_STEPS or not _comparable(measured, predicted):
            return measured, UNTESTED
        nis = normalised_innovation_squared(measured, predicted)
        if nis <= GATE_NIS:
            self._rejected_in_a_row = 0
            return measured, GateResult("accepted", nis)
        if self._rejected_in_a_row > MAX_REJECTIONS:
            return measured, GateResult("trusted again", nis)
        if nis <= GROSS_NIS:
            return measured.wider(inflation_to_gate(measured, predicted)), GateResult("down-weighted", nis)
        self._rejected_in_a_row += 1
        verdict: Verdict = "relocated" if self._rejected_in_a_row > MAX_REJECTIONS else "rejected"
        details = {**measured.details, "nis": nis}
        return replace(bridge, ok=False, drift=None, earlier_scans=(), details=details), GateResult(verdict, nis)


def _comparable(measured: RelativePose, predicted: RelativePose) -> bool:
    """Whether both are measurements, independent of each other, and the IMU knows its speed well enough to judge."""
    if not predicted.ok or not measured.ok or measured.from_imu:
        return False
    return predicted.translation_sigma_m <= UNKNOWN_TRANSLATION_SIGMA_M
