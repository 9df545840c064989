"""The innovation gate: compares each relative pose with the IMU's prediction and decides which of the two is wrong.

The test statistic is the normalised innovation squared (NIS): the squared difference of measurement and prediction
under the sum of their covariances (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation" (2001), §5.4.2). Where both covariances are right it is χ² distributed with six degrees of freedom.

A difference alone does not tell which side is wrong. The scans do, because each is registered to the map by itself:
if the path that they found is smooth while the IMU contradicts two steps of it in a row, the IMU is wrong. If the path
jumps, or moves on beside its jump as the IMU predicts, the scan is. Scans that leave a direction unconstrained, as
those of a narrow lidar on open ground do, drift smoothly and are no judges of the IMU.

Where neither is shown to be right, the position is doubted (:mod:`hybridlio.sources.gate.position_doubt`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.sources.gate.gate_result import GATE_NIS, UNTESTED, GateResult
from hybridlio.sources.gate.motion_change import MotionChange
from hybridlio.sources.gate.position_doubt import PositionDoubt

GROSS_NIS = 10 * GATE_NIS  # a right pose stays below even with covariances 10 times too small; above, the pose is wrong
MAX_REJECTIONS = 5  # in a row: half a second at 10 Hz; the IMU bridges so long to a few decimetres
WARM_UP_STEPS = 10  # one second at 10 Hz, in which speed, tilt and biases are still being found from the scans
_BISECTIONS = 40  # halves the bracket to 1e-12 of its width, below any effect on a covariance
# Verdicts after which the next scan is expected to continue this scan's motion; after others, that of the scan before
_MOVES_ON = ("untested", "accepted", "undecided", "IMU left out")


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
    """Tests each step's relative pose against the IMU's prediction.

    After :data:`MAX_REJECTIONS` rejections in a row, the position in the map may be lost. The next relative pose is
    then a jump in the map, not a motion, and is rejected too; those after it agree with the IMU again. If they do not,
    the IMU is left out.

    Args:
        takes_back: whether the residual source can take a scan back, so that the path continues by the bridge.
    """

    def __init__(self, takes_back: bool = True) -> None:
        self._takes_back = takes_back
        self._steps = 0
        self._rejected_in_a_row = 0
        self._undecided = False
        self._motion = MotionChange()
        self.doubt = PositionDoubt(WARM_UP_STEPS)
        self._determined_in_a_row = 0  # scans until now that constrain every direction
        # the last scan, where it was found, in the pose that the source's path has for it; None if they are the same
        self._found: Array | None = None

    @property
    def is_warming_up(self) -> bool:
        """Whether the next step is one in which speed, tilt and biases are still being found from the scans."""
        return self._steps < WARM_UP_STEPS

    def apply(
        self,
        measured: RelativePose,
        predicted: RelativePose | None,
        bridge: RelativePose,
        dt_s: float,
        leaves_out_imu: bool = False,
    ) -> tuple[RelativePose, GateResult]:
        """Return the relative pose that the backend is to use, and the gate's result.

        Args:
            measured: the residual source's relative pose.
            predicted: the IMU's; None where there is no inertial data.
            bridge: the relative pose that replaces a rejected one.
            dt_s: duration of the step.
            leaves_out_imu: the IMU is not to be used; only its innovation is wanted.
        """
        self._steps += 1
        is_determined = measured.ok and not len(measured.degenerate)
        self._determined_in_a_row = self._determined_in_a_row + 1 if is_determined else 0
        own = measured
        if self._found is not None:
            own = replace(measured, pose=se3.between(self._found, measured.pose))
        if leaves_out_imu:
            tested = predicted if _comparable(own, predicted) else None
            nis = None if tested is None else normalised_innovation_squared(own, tested)
            relative, result = measured, GateResult("IMU left out", nis)
        else:
            relative, result = self._tested(measured, own, predicted, bridge, dt_s)
        is_believed = result.verdict in ("untested", "IMU left out")
        is_doubtful = is_believed and self._is_doubtful(own, predicted, dt_s)
        self.doubt.learn(measured, own, result.verdict, (result.nis or 0.0) > GROSS_NIS, is_doubtful)
        if measured.ok and result.verdict in _MOVES_ON:
            # the IMU confirms the path: then the step to this scan is from the bridge, not from a scan found wrongly
            step = measured.pose if result.verdict == "accepted" else own.pose
            is_typical = is_determined and self._found is None and result.verdict in ("untested", "accepted")
            self._motion.learn(step, dt_s, is_typical)
        taken_back = result.takes_back and self._takes_back
        self._found = se3.between(bridge.pose, measured.pose) if taken_back else None
        return relative, result

    def _is_doubtful(self, own: RelativePose, predicted: RelativePose | None, dt_s: float) -> bool:
        """Whether scans that are believed without the IMU contradict it grossly, and move abruptly at that."""
        if predicted is None or not _comparable(own, predicted) or not self._motion.is_abrupt(own.pose, dt_s):
            return False
        return normalised_innovation_squared(own, predicted) > GROSS_NIS

    def _tested(
        self,
        measured: RelativePose,
        own: RelativePose,
        predicted: RelativePose | None,
        bridge: RelativePose,
        dt_s: float,
    ) -> tuple[RelativePose, GateResult]:
        """As :meth:`apply`; ``own`` is the step from where the last scan was found to where this one is."""
        was_undecided, self._undecided = self._undecided, False
        if self._steps <= WARM_UP_STEPS or not _comparable(measured, predicted):
            return measured, UNTESTED
        assert predicted is not None
        nis, parts = normalised_innovation_squared(measured, predicted), _parts(measured, predicted)
        if nis <= GATE_NIS:
            self._rejected_in_a_row = 0
            return measured, GateResult("accepted", nis, parts)
        contradicts_path = normalised_innovation_squared(own, predicted) > GATE_NIS
        can_judge = self._determined_in_a_row > WARM_UP_STEPS
        smooth = can_judge and contradicts_path and self._motion.continues(own.pose, dt_s)
        if self._rejected_in_a_row > MAX_REJECTIONS or (smooth and was_undecided):
            return measured, GateResult("IMU left out", nis, parts)
        if smooth and nis > GROSS_NIS:  # smaller contradictions are the covariances': scans that a lidar repeats badly
            self._undecided = True
            return _either(measured, bridge, nis), GateResult("undecided", nis, parts)
        if nis <= GROSS_NIS:
            return _scattered(measured, inflation_to_gate(measured, predicted)), GateResult("down-weighted", nis, parts)
        self._rejected_in_a_row += 1
        if self._rejected_in_a_row > MAX_REJECTIONS:
            return _bridged(measured, bridge, nis, drift=None), GateResult("relocated", nis, parts)
        return _bridged(measured, bridge, nis, measured.drift), GateResult("rejected", nis, parts)


def _bridged(measured: RelativePose, bridge: RelativePose, nis: float, drift: Array | None) -> RelativePose:
    """Return the bridge. With ``drift``, the source's path continues by it, and loses nothing: the next scan is
    registered to the same map."""
    return replace(bridge, ok=False, drift=drift, earlier_scans=(), details={**measured.details, "nis": nis})


def _either(measured: RelativePose, bridge: RelativePose, nis: float) -> RelativePose:
    """Return the bridge with a covariance that spans the measured pose too."""
    difference = _innovation(bridge, measured)
    wide = replace(bridge, covariance=bridge.covariance + np.outer(difference, difference))
    return _bridged(measured, wide, nis, measured.drift)


def _scattered(measured: RelativePose, times: float) -> RelativePose:
    """Return the relative pose with a larger scatter. Its drift stays: the next scan finds the map where it was."""
    wide = measured.wider(times)
    return wide if measured.drift is None else replace(wide, drift=measured.drift)


def _parts(measured: RelativePose, predicted: RelativePose) -> tuple[float, float]:
    innovation, total = _innovation(measured, predicted), measured.covariance + predicted.covariance
    rotation, translation = slice(0, 3), slice(3, 6)
    return (
        _nis(innovation[rotation], total[rotation, rotation]) / 3,
        _nis(innovation[translation], total[translation, translation]) / 3,
    )


def _comparable(measured: RelativePose, predicted: RelativePose | None) -> bool:
    """Whether both are measurements, independent of each other, and the IMU knows its speed well enough to judge."""
    if predicted is None or not predicted.ok or not measured.ok or measured.from_imu:
        return False
    return predicted.translation_sigma_m <= UNKNOWN_TRANSLATION_SIGMA_M
