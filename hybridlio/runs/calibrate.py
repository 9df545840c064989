"""Calibration of a recording: extrinsics and clocks of its sensors, from the recording alone.

The scans are compensated for motion by the calibration that is to be found, and a wrong one bends the path that they
give. So odometry and smoothing with the calibration as variables are repeated, each time with the calibration of the
last round.

A round does not show all of an error of the clock, because the scans that it is compared with were compensated by the
same clock: between 0.15 and 0.6 of it in simulated scenes. So what a round finds is divided by that share, which is the
slope between rounds at different clocks (secant method). Its standard deviation is divided too, and else would claim
two to seven times too much. Where the rounds' clocks are too close for a slope, one round is made beside them.

Steps of scan matching state larger covariances than their errors, so all variances are multiplied by the χ² per degree
of freedom that the last round left (the variance of unit weight of adjustment theory; Koch, "Parameter Estimation and
Hypothesis Testing in Linear Models", 1999, section 3.2). As the scans follow the samples that compensate them,
residuals show no more of the motion's errors than of the clock's, and χ² the square of that share: the clock's factor
is divided by it, up to the stated covariances.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Items
from dataclasses import replace

import numpy as np

from hybridlio.calibration.imu_check import moved
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import ImuNoise
from hybridlio.datasets.sequence import Sequence
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.recording_check import compare_imu
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.run_log import HeldBack
from hybridlio.runs.scale_search import SETTLED_SIGMAS, ScaleSearch
from hybridlio.smoothing.calibration import IMU_SCALE, OF_GPS, OF_IMU, Calibrated, CalibrationPriors, Parameter

_NEWEST = 3  # rounds that give the slope: earlier ones had another mounting
_MOST_ROUNDS = 6  # one of them beside the others, for the share of an error that a round shows
# Two rounds are to follow. Where the share is small the clock creeps, and would not settle before without it.
_LAST_PROBE = _MOST_ROUNDS - 2
_SCALE_ROUNDS = 3  # the first leaves a tenth of an error, the second what the path's noise allows
_LEAST_SHARE = 0.1  # of a clock's error that a round shows: less cannot be told from noise
# Beside the clock that a round found: ten times its usual standard deviation, so that the slope is known to a tenth,
# and a twentieth of the time between two scans, over which motion hardly changes.
_PROBE_S = 5e-3
_CLOCK = "gps_clock"  # which is found anew in every round
_LEAST_SCANS = 100  # ten seconds; fewer seldom determine a rotation to a degree


def calibrate(
    sequence: Sequence,
    parameters: Items[str] | CalibrationPriors = OF_IMU,
    *,
    config: Config | None = None,
    progress: Progress | None = None,
) -> Calibrated:
    """Find the calibration of a recording's sensors; turn about every axis while recording.

    Args:
        sequence: the recording, with IMU samples. Its calibration is where the search starts: extrinsics within 10° and
            a few decimetres, clocks within 0.2 s.
        parameters: names of :data:`hybridlio.smoothing.calibration.CALIBRATED`, or what is known of them before. With
            ``imu_scale`` also scale and misalignment of the IMU's axes (:mod:`hybridlio.calibration.imu_scale`).
        config: settings of the odometry.
        progress: called with the stage, the steps done and the steps in total.

    Returns:
        The calibration, with the change of each parameter against the stated one and its covariance, which includes
        what the last round still changed.

    Raises:
        ConfigError: an unknown parameter, or one whose sensor the recording lacks.
        DataError: fewer than 100 scans, or samples that do not belong to the scans at all.
    """
    with_scale = not isinstance(parameters, CalibrationPriors) and IMU_SCALE in parameters
    priors = parameters if isinstance(parameters, CalibrationPriors) else _priors(parameters)
    priors.check_sensors(has_imu=len(sequence.imu) > 0, has_gps=len(sequence.gps) > 0)
    if len(sequence) < _LEAST_SCANS:
        raise DataError(f"{sequence.name}: {len(sequence)} scans; calibration needs {_LEAST_SCANS} or more")
    search = _Search(sequence, priors, config or Config(), progress or _silent)
    search.start()
    if with_scale:
        search.find_scale()
    for number in range(1, _MOST_ROUNDS + 1 if priors.names else 1):
        if search.round(number):
            break
    return search.result()


def _priors(names: Items[str]) -> CalibrationPriors:
    """Return priors of what smoothing finds: all but the scale."""
    if isinstance(names, str):
        return CalibrationPriors(names)  # which says that several names are expected
    return CalibrationPriors([name for name in names if name != IMU_SCALE])


class _Search:
    """The search, with the recording at the calibration that was found last."""

    def __init__(self, sequence: Sequence, priors: CalibrationPriors, config: Config, report: Progress) -> None:
        self._stated, self._now = sequence.calibration, sequence
        self._priors, self._config, self._report = priors, config, report
        self._stated_offset_s = sequence.imu_time_offset_s or 0.0  # the reader has applied it, and the scale
        self._stated_scale = sequence.imu_scale
        self._offset_s = 0.0  # added to the stamps of the samples since
        self._rounds: list[tuple[float, float]] = []  # clock of a round, and the change that it found
        self._best_s = 0.0  # the clock that the rounds so far mean
        self._share = 1.0  # of a clock's error that a round shows
        self._variance_factor = 1.0  # of the last round, by which all variances are multiplied
        self._found: Calibrated | None = None
        self._scale: ScaleSearch | None = None
        self._warnings: HeldBack | None = None  # of the last round; those before concern what was replaced

    def start(self) -> None:
        """Correct units, and take the clocks' offset from the check of recordings, which costs a part of a round.

        Raises:
            DataError: the samples do not belong to the scans.
        """
        check = compare_imu(self._now, lambda _, done, total: self._report("comparing the IMU", done, total))
        if check is None:
            return
        if check.wrong:
            raise DataError(f"{self._now.name}: {check.wrong[0]}")
        self._now, offset = replace(self._now, imu=check.imu), check.offset
        if offset is not None and offset.is_significant:
            self._offset_s = offset.offset_s  # which check.imu has
        elif offset is not None and offset.is_determined and "time_offset" in self._priors.names:
            self._move(offset.offset_s)
        self._best_s = self._offset_s

    def find_scale(self) -> None:
        """Find the IMU's scale, before the graph compares samples with scans: a wrong one contradicts them.

        The matrices also turn the IMU's axes into those of the stated extrinsics, so that what the extrinsics' rotation
        is wrong by is found here.
        """
        self._scale = ScaleSearch()
        for number in range(1, _SCALE_ROUNDS + 1):

            def odometry(text: str, done: int, total: int, number: int = number) -> None:
                self._report(f"scale, round {number}: {text}", done, total)

            with HeldBack() as self._warnings:
                path = self._run(odometry).odometry.record().online
            self._now = replace(self._now, imu=self._scale.correct(path, self._now))
            if self._scale.is_settled:
                break

    def round(self, number: int) -> bool:
        """Run odometry and smoothing once; return whether the calibration has settled."""

        def odometry(text: str, done: int, total: int) -> None:
            self._report(f"odometry, round {number}: {text}", done, total)

        uses_gps = bool(set(self._priors.names) & set(OF_GPS))
        # a run that trusts the IMU less does so for the wrong calibration, which here is a variable
        imu_noise = self._config.imu_noise or self._now.imu_noise or ImuNoise()
        with HeldBack() as self._warnings:
            record = replace(self._run(odometry).odometry.record(), imu_noise=imu_noise)
            smoothed = smooth(record, gps=uses_gps, calibrate=self._priors)
        found: Calibrated = smoothed.found["calibration"]
        sigmas = {one.name: one.sigmas for one in found.parameters}
        factor = self._variance_factor = smoothed.verdict.variance_factor
        found = replace(found, parameters=tuple(one.scaled(factor) for one in found.parameters))
        self._now = replace(self._now, calibration=found.calibration)
        moves = {one.name: one.change for one in found.parameters if one.name != _CLOCK}
        is_probed = True
        if "time_offset" in moves:
            is_probed = self._take_clock(found.imu_time_offset_s, float(sigmas["time_offset"][0]))
            moves["time_offset"] = np.array([self._offset_s - self._best_s])
            self._best_s = self._offset_s
            found = replace(found, parameters=tuple(map(self._widened, found.parameters)))
            sigmas["time_offset"] = sigmas["time_offset"] / self._share
        self._found = replace(found, parameters=tuple(self._against_stated(one, moves) for one in found.parameters))
        settled = all(bool((np.abs(move) <= SETTLED_SIGMAS * sigmas[name]).all()) for name, move in moves.items())
        if not is_probed and (settled or number == _LAST_PROBE) and number <= _LAST_PROBE:
            self._move(_PROBE_S)
            return False
        return settled and is_probed

    def _run(self, report: Progress) -> Run:
        run = run_odometry(self._now, Odometry(config=self._config), report)
        if run.stopped is not None:
            raise run.stopped
        return run

    def _take_clock(self, found_s: float, sigma_s: float) -> bool:
        """Move to the clock that a round's finding means; return whether rounds at different clocks show its share."""
        self._rounds.append((self._offset_s, found_s))
        clocks, changes = np.array(self._rounds[-_NEWEST:]).T
        is_probed = bool(np.ptp(clocks) > _PROBE_S / 2 and np.ptp(clocks) > 10 * sigma_s)
        if is_probed:
            slope = -float(np.polyfit(clocks, changes, 1)[0])
            self._share = float(np.clip(slope, _LEAST_SHARE, 1.0))
        self._move(found_s / self._share)
        return is_probed

    def _widened(self, found: Parameter) -> Parameter:
        """Return the clock with the variance of what a round finds, divided by the share that it shows.

        The residuals that the variance was multiplied for show the same share.
        """
        if found.name != "time_offset":
            return found
        hidden = min(1 / self._share**2, max(1 / self._variance_factor, 1.0))
        return replace(found, covariance=hidden * found.covariance / self._share**2)

    def result(self) -> Calibrated:
        """Return what the last round found, after its warnings."""
        if self._warnings is not None:
            self._warnings.show()
        found = self._found or Calibrated(self._stated, 0.0, 0.0, ())
        found = replace(found, imu_time_offset_s=self._stated_offset_s + self._offset_s)
        return found if self._scale is None else self._scale.added_to(found, self._stated_scale)

    def _move(self, seconds: float) -> None:
        self._now = replace(self._now, imu=moved(self._now.imu, seconds))
        self._offset_s += seconds

    def _against_stated(self, found: Parameter, moves: Mapping[str, Array]) -> Parameter:
        """Return a parameter's change against what was stated; what the round changed adds to its variance."""
        now, stated = self._now.calibration, self._stated
        antenna, before = (np.zeros(3) if c.antenna_imu_m is None else c.antenna_imu_m for c in (now, stated))
        total = {
            "rotation": se3.so3_log(stated.T_imu_lidar[:3, :3].T @ now.T_imu_lidar[:3, :3]),
            "translation": now.T_imu_lidar[:3, 3] - stated.T_imu_lidar[:3, 3],
            "time_offset": np.array([self._offset_s]),
            "lever_arm": antenna - before,
        }.get(found.name, found.change)
        moved_by = moves.get(found.name, np.zeros_like(found.change))
        spread = found.covariance + np.outer(moved_by, moved_by)
        return replace(found, change=np.asarray(total), covariance=spread)


def _silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""
    del stage, done, total
