"""What a smoothing calibrates, from round to round: extrinsics, clocks and the antenna."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import T

from hybridlio.core.estimates import State
from hybridlio.graph.base.marginals import Covariance, Marginals
from hybridlio.graph.run.antenna import Antenna
from hybridlio.graph.run.calibrated_links import CalibratedLinks
from hybridlio.graph.run.gps_factors import GpsGroup
from hybridlio.graph.run.loop_factors import LoopClosures
from hybridlio.record.record import Record
from hybridlio.smoothing.calibration import OF_IMU, Calibrated, CalibrationPriors, Parameter, undetermined_directions

_ROUNDS = 2  # without calibration; the second preintegrates the samples again, with the biases that the first found
_MAX_ITERATIONS = 50  # a bound against endless descent; Smoothed.converged says whether it was reached
# With calibration the rounds are Gauss-Newton's steps for it: three to five where the motion determines it well, more
# where it hardly does (tests/graph/run/test_run_calibration.py). Within a round a few iterations are enough.
_CALIBRATION_ROUNDS, _CALIBRATION_ITERATIONS = 15, 8


class RunCalibration:
    """The calibration of a run in smoothing.

    Args:
        record: of the run, with the stated calibration.
        priors: what to calibrate, and what is known before.
        fixes: the run's GPS fixes; none or one.
        loops: its loops; none or one. They follow the extrinsics, as the fixes do.

    Attributes:
        rounds, iterations: bounds of the rounds, and of the iterations in each.
    """

    def __init__(
        self, record: Record, priors: CalibrationPriors, fixes: Sequence[GpsGroup], loops: Sequence[LoopClosures]
    ) -> None:
        self._record, self._names = record, priors.names
        self._links = CalibratedLinks(record, priors) if set(priors.names) & set(OF_IMU) else None
        self._fixes = fixes
        self._mounted: list[GpsGroup | LoopClosures] = [*fixes, *loops]
        parts: list[CalibratedLinks | Antenna] = [fix.antenna for fix in fixes if fix.antenna.is_variable]
        self._parts = parts if self._links is None else [self._links, *parts]
        self.rounds = _CALIBRATION_ROUNDS if self._parts else _ROUNDS
        self._is_settled = False
        self.iterations = _CALIBRATION_ITERATIONS if self._parts else _MAX_ITERATIONS

    def applied(self) -> Record:
        """Return the record with the calibration found so far."""
        return self._record if self._links is None else self._links.applied()

    def link(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, states: Sequence[State]) -> None:
        """Make the lidar's mounting and the clock variables of a round's graph, if they are calibrated."""
        if self._links is not None:
            self._links.link(graph, values, states)

    def take(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> bool:
        """Take over a round's solution; return whether no further round is needed for the calibration."""
        if not self._parts:
            return False
        covariance = Marginals(graph, values).covariance
        settled = [part.take(values, covariance) for part in self._parts]
        for group in self._mounted if self._links is not None else []:
            group.T_imu_lidar = self.applied().calibration.T_imu_lidar
        held = [part.hold(covariance) for part in self._parts] if all(settled) else []
        self._is_settled = all(settled) and not any(held)
        return self._is_settled

    def has_converged(self, iterations: int) -> bool:
        """Whether the last round, of ``iterations``, was the last that is needed."""
        return self._is_settled if self._parts else iterations < self.iterations

    def results(self, values: gtsam.Values, covariance: Covariance) -> dict[str, Calibrated]:
        """Return what was found as ``calibration``; nothing where nothing is calibrated."""
        if not self._names:
            return {}
        parameters = [parameter for part in self._parts for parameter in part.parameters(covariance)]
        shift_s = float(values.atVector(T(0))[0]) if self._fixes else 0.0
        if "gps_clock" in self._names:
            spread, before_s = covariance([T(0)]), self._fixes[0].max_shift_s
            undetermined = undetermined_directions(spread, before_s)
            parameters.append(Parameter("gps_clock", np.array([shift_s]), spread, before_s, undetermined))
        calibration = self.applied().calibration
        if self._fixes and "lever_arm" in self._names:
            calibration = replace(calibration, antenna_imu_m=self._fixes[0].antenna.position_m)
        offset_s = self._record.imu_time_offset_s + (0.0 if self._links is None else self._links.offset_s)
        return {"calibration": Calibrated(calibration, offset_s, shift_s, tuple(parameters))}
