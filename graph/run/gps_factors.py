"""GPS fixes in offline smoothing, with the frame and the clock of the fixes estimated.

Fixes are in a local east-north-up frame, the run's poses in its own world. The pose of one in the other and a constant
time shift between their clocks are variables of the graph. A fix falls between two scans: the motion from the nearest
scan to its time is taken from the path (:class:`hybridlio.core.pose_interpolation.PosePath`) as a lever arm, which the
time shift moves along the velocity. Within 50 ms the path is known to millimetres and a fix to decimetres, so the
interpolation adds no variable and no noise; each round recomputes the lever arms.

Keys: ``e`` pose of the run's world in the frame of the fixes; ``t`` time shift in seconds; ``o`` the antenna in the IMU
frame, if it is calibrated; for each fix the antenna's
position in three frames, ``a`` in the scan's, ``w`` in the run's world, ``p`` in the fixes'. These points let GTSAM's
own factors connect a scan to a fix. One factor written in Python would need no points, but it gets a copy of all values
at every evaluation, which takes longer than everything else on a long run.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, E, G, O, P, T, W, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.core.estimates import State
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.graph.base import noise
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.run.antenna import Antenna
from hybridlio.graph.run.factor_groups import GroupFactors, GroupSolution, PossibleOutlier
from hybridlio.record.record import Record
from hybridlio.smoothing.gps_alignment import LEVEL_SIGMA_RAD, FixAlignment, align_fixes, fix_stamps
from hybridlio.smoothing.gps_options import GpsFit, GpsOptions

# Gravity against the up of the fixes' frame: deflections of the vertical rarely exceed 3e-4 rad (60 arc seconds), and
# the Earth's curvature turns it by 1.6e-4 rad a kilometre.
_PLUMB_SIGMA_RAD = 5e-4
# An uninformative prior of the fixes' frame, more than a turn and farther than a run goes, so that GTSAM always finds
# it determined.
_FRAME_SIGMAS = np.r_[np.full(3, 10.0), np.full(3, 1e5)]
_LINK_SIGMA_M = 1e-3  # between a point and its image in the next frame: far below a fix's noise
_LEAST_SHIFT_SIGMA_S = 1e-6  # where the clocks are known to agree; a microsecond is no motion
_MEDIAN_CHI2 = 2.366  # median of χ² of three degrees of freedom
_SECOND_DIFFERENCE = 6.0  # 1 + 4 + 1: variance of x[-1] - 2 x[0] + x[1] of independent x
_LEAST_FOR_SPREAD = 10  # fewer second differences have no stable median
_LONGEST_PAUSE = 1.5  # of the median interval: between fixes farther apart the path's drift would show


class GpsGroup:
    """A record's fixes as a group of factors.

    Args:
        record: of the run, with its fixes.
        options: how to use them.
        antenna_sigma_m: standard deviation of the antenna's stated position, to calibrate it; None takes it as it is.
    """

    name = "gps"

    def __init__(
        self, record: Record, options: GpsOptions | None = None, antenna_sigma_m: float | None = None
    ) -> None:  # fmt: skip
        self._options = options or GpsOptions()
        self.robust = self._options.robust
        self._fixes = record.gps
        self.T_imu_lidar = record.calibration.T_imu_lidar
        stated = self._options.antenna_m if self._options.antenna_m is not None else record.calibration.antenna_imu_m
        self.antenna = Antenna(np.zeros(3) if stated is None else np.asarray(stated, np.float64), antenna_sigma_m)
        self._scale: float | None = None
        self._rows: Index = np.empty(0, np.int64)

    @property
    def max_shift_s(self) -> float:
        """Standard deviation of the clock's shift before."""
        return max(self._options.max_shift_s, _LEAST_SHIFT_SIGMA_S)

    def build(self, states: Sequence[State], previous: gtsam.Values | None) -> GroupFactors:
        """Return one possible outlier per fix, with the factors and initial values of frame and clock.

        Raises:
            EstimationError: too few fixes lie in the run's time.
        """
        path = _path_of(states)
        if previous is None:
            aligned = self._align(path, states[0])
            T_enu_world, shift = aligned.T_enu_world, aligned.shift_s
            self._scale = _noise_scale([self._fixes[k] for k in self._rows], aligned.residuals_m, aligned.inliers)
        else:
            T_enu_world, shift = previous.atPose3(E(0)).matrix(), float(previous.atVector(T(0))[0])
        values = gtsam.Values()
        values.insert(E(0), gtsam.Pose3(T_enu_world))
        values.insert(T(0), np.array([shift]))
        group = GroupFactors([*self._priors(T_enu_world), _plumb_factor(states[0])], values=values)
        self.antenna.add_to(group)
        self._add_fixes(group, path, shift, T_enu_world)
        return group

    def _align(self, path: PosePath, start: State) -> FixAlignment:
        """Choose the fixes to use, and return their rigid alignment."""
        stamps = fix_stamps(self._fixes)
        out = np.zeros(len(stamps), dtype=bool)
        for first, last in self._options.outages:
            out |= (stamps >= first) & (stamps <= last)
        self._rows = np.flatnonzero(~out)
        up, sigma = _up_of(start)
        aligned = align_fixes(
            path, [self._fixes[k] for k in self._rows], self.antenna.position_m, up, sigma, self._options.max_shift_s
        )
        self._rows = self._rows[aligned.used]
        kept = aligned.used
        return FixAlignment(
            aligned.T_enu_world, aligned.shift_s, aligned.covariance, aligned.residuals_m[kept], kept[kept],
            aligned.inliers[kept],
        )  # fmt: skip

    def _priors(self, T_enu_world: Array) -> list[gtsam.NonlinearFactor]:
        """Priors: the frame may be anywhere, the shift is within the searched range."""
        anywhere = noise.sigmas(_FRAME_SIGMAS)
        shift = noise.sigmas(np.array([self.max_shift_s]))
        return [
            gtsam.PriorFactorPose3(E(0), gtsam.Pose3(T_enu_world), anywhere),
            gtsam.PriorFactorVector(T(0), np.zeros(1), shift),
        ]

    def _add_fixes(self, group: GroupFactors, path: PosePath, shift_s: float, T_enu_world: Array) -> None:
        """Add each fix's points ``a``, ``w``, ``p``, the links between them, and the fix itself at ``p``."""
        fixes = [self._fixes[k] for k in self._rows]
        stamps = fix_stamps(fixes, shift_s)
        near = path.nearest(stamps)
        points, velocities = path.points(stamps, self.antenna.position_m)
        placed = se3.transform(T_enu_world, points)
        T_scan_world = se3.inverse(path.poses[near])
        levers = (T_scan_world @ np.column_stack([points, np.ones(len(points))])[..., None])[:, :3, 0]
        lever_rates = (T_scan_world[:, :3, :3] @ velocities[..., None])[..., 0]
        turns = T_scan_world[:, :3, :3] @ path.at(stamps)[:, :3, :3]  # of the IMU from the fix to the scan
        link = noise.sigmas(np.full(3, _LINK_SIGMA_M))
        for n, (k, fix) in enumerate(zip(near.tolist(), fixes, strict=True)):
            for key, value in ((A(n), levers[n]), (W(n), points[n]), (P(n), placed[n])):
                group.values.insert(key, value)
            links = [
                self._lever_factor(n, levers[n], (lever_rates[n], turns[n]), shift_s, link),
                gtsam.ReferenceFrameFactorPoint3Pose3(A(n), X(k), W(n), link),
                gtsam.ReferenceFrameFactorPoint3Pose3(W(n), E(0), P(n), link),
            ]
            group.trusted.extend(links)
            covariance = (self._scale or 1.0) ** 2 * fix.covariance_m2
            group.possible_outliers.append(
                PossibleOutlier(
                    partial(gtsam.PriorFactorPoint3, P(n), fix.position_m), covariance, f"GPS fix at {fix.stamp_ns} ns"
                )
            )

    def _lever_factor(
        self, n: int, lever: Array, rates: tuple[Array, Array], shift_s: float, model: gtsam.noiseModel.Base
    ) -> gtsam.NonlinearFactor:
        """The linear factor ``a = lever + velocity · (t - shift) + turn · (o - antenna)``; velocity and turn: rates."""
        at, (velocity, turn) = gtsam.Values(), rates
        at.insert(A(n), lever)
        at.insert(T(0), np.array([shift_s]))
        terms = [A(n), np.eye(3), T(0), -velocity[:, None]]
        if self.antenna.is_variable:
            at.insert(O(0), self.antenna.position_m)
            terms += [O(0), -turn]
        make: Any = gtsam.JacobianFactor  # its stubs lack this overload
        return gtsam.LinearContainerFactor(make(*terms, np.zeros(3), model), at)

    def read(self, solution: GroupSolution) -> GpsFit:
        """Return frame, clock, and how each fix fits."""
        T_enu_imu = solution.values.atPose3(E(0)).matrix()
        shift = float(solution.values.atVector(T(0))[0])
        joint = solution.covariance([E(0), T(0)])
        count = len(self._fixes)
        residuals, weights, used = np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, bool)
        used[self._rows] = True
        weights[self._rows] = solution.weights
        points, _ = _path_of(solution.states).points(
            fix_stamps([self._fixes[k] for k in self._rows], shift), self.antenna.position_m
        )
        positions = np.array([self._fixes[k].position_m for k in self._rows])
        residuals[self._rows] = se3.transform(T_enu_imu, points) - positions
        T_imu_lidar = self.T_imu_lidar
        covariance = se3.rotate_covariance(joint[:6, :6], se3.inverse(T_imu_lidar))
        return GpsFit(
            T_enu_imu @ T_imu_lidar, covariance, shift, float(np.sqrt(joint[6, 6])), residuals, used, weights,
            self._scale or 1.0, self.antenna.position_m,
        )  # fmt: skip


def _path_of(states: Sequence[State]) -> PosePath:
    stamps = np.array([state.stamp_ns for state in states])
    poses = np.array([state.T_world_imu for state in states])
    velocities = np.array([state.velocity_m_s for state in states]) if states[0].has_imu else None
    return PosePath(stamps, poses, velocities)


def _up_of(state: State) -> tuple[Array, float]:
    """Return the direction up ``(3,)`` in the run's world, of any length, and its standard deviation in rad."""
    if not state.has_imu:
        return co.UP, LEVEL_SIGMA_RAD
    spread = float(np.sqrt(np.trace(state.gravity_covariance) / 3)) / float(np.linalg.norm(state.gravity_m_s2))
    return -state.gravity_m_s2, float(np.hypot(spread, _PLUMB_SIGMA_RAD))


def _plumb_factor(start: State) -> gtsam.NonlinearFactor:
    """The frame's up is opposite to gravity; without IMU, the lidar is assumed to start about level."""
    if not start.has_imu:
        model = noise.sigmas(np.full(2, LEVEL_SIGMA_RAD))
        return gtsam.AttitudeFactorPose3(E(0), gtsam.Unit3(co.UP), model, gtsam.Unit3(co.UP))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R = values.atPose3(E(0)).rotation().matrix()
        gravity = values.atVector(G(0))
        length = float(np.linalg.norm(gravity))
        down = gravity / length
        if jacobians is not None:
            jacobians[0] = np.hstack([-R @ se3.hat(down), np.zeros((3, 3))])[:2]
            jacobians[1] = (R @ (np.eye(3) - np.outer(down, down)) / length)[:2]
        return np.asarray((R @ down)[:2])

    return gtsam.CustomFactor(noise.sigmas(np.full(2, _PLUMB_SIGMA_RAD)), [E(0), G(0)], error)


def _noise_scale(fixes: Sequence[GpsFix], residuals: Array, inliers: Mask) -> float:
    """Return the ratio of the fixes' scatter to their claimed standard deviations, at least 1.

    From second differences of consecutive residuals, which cancel the drift of the path; from their median, and without
    outliers of the alignment, so that wrong fixes do not count. Errors that neighbouring fixes share cancel too, so the
    ratio is a lower bound.

    Args:
        fixes: ``M`` of them.
        residuals: ``(M, 3)`` of their alignment.
        inliers: ``(M,)`` of their alignment.
    """
    stamps = fix_stamps(fixes) / NS_PER_S
    steps = np.diff(stamps)
    if len(steps) < _LEAST_FOR_SPREAD:
        return 1.0
    consecutive = np.maximum(steps[1:], steps[:-1]) < _LONGEST_PAUSE * np.median(steps)
    regular = np.flatnonzero(consecutive & inliers[2:] & inliers[1:-1] & inliers[:-2])
    if len(regular) < _LEAST_FOR_SPREAD:
        return 1.0
    second = residuals[regular] - 2 * residuals[regular + 1] + residuals[regular + 2]
    covariances = np.array([fixes[k + 1].covariance_m2 for k in regular.tolist()]) * _SECOND_DIFFERENCE
    chi2 = np.einsum("ni,nij,nj->n", second, np.linalg.inv(covariances), second)
    return float(np.sqrt(max(np.median(chi2) / _MEDIAN_CHI2, 1.0)))
