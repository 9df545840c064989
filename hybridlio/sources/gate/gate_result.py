"""What the innovation gate decides at a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["untested", "accepted", "undecided", "IMU left out", "down-weighted", "rejected", "relocated"]

GATE_NIS = 27.86  # 99.99 % quantile of χ² with six degrees of freedom: one right measurement in 10,000 is above


@dataclass(frozen=True)
class GateResult:
    """Outcome of the gate at one step.

    Attributes:
        verdict: what was done with the relative pose:

            * ``untested``: passed on; there is no usable prediction, or the run is in its first steps.
            * ``accepted``: passed on; the innovation is within the gate.
            * ``undecided``: a gross contradiction on a smooth path; replaced by the bridge, whose covariance spans
              both; the IMU's samples are left out too. The residual source is asked to take the scan back; the next
              scan decides.
            * ``IMU left out``: passed on without the IMU's samples, which contradict the scans or did so lately.
            * ``down-weighted``: passed on with a covariance inflated until the innovation is at the gate.
            * ``rejected``: replaced by the bridge; the residual source is asked to take the scan back.
            * ``relocated``: replaced by the bridge after too many rejections in a row, but the residual source
              continues from where it found the scan.
        nis: normalised innovation squared; None where untested.
        parts: of rotation and translation alone, each divided by its three degrees of freedom.
    """

    verdict: Verdict
    nis: float | None = None
    parts: tuple[float, float] | None = None

    @property
    def uses_imu(self) -> bool:
        """Whether the step's samples may go into the graph."""
        return self.verdict not in ("undecided", "IMU left out")

    @property
    def takes_back(self) -> bool:
        """Whether the residual source is to continue as if the scan had failed."""
        return self.verdict in ("undecided", "rejected")


UNTESTED = GateResult("untested")
