"""The start of a lidar that does not repeat its pattern: its first motion is decided over several scans.

Two of its scans fit each other nearly as well metres away as where they were. Taken for sure, a false fit makes a false
map, which later scans then fit, too. So all scans since the first are placed by one smooth motion
(:mod:`hybridlio.registration.joint_motion`), from many starts. Each new scan is one more to agree, and motions under
which the points fit significantly worse are dropped. While several are left, there are few scans, or a new one
still moves the one before, the step is that of the slowest motion, with a covariance that spans the others. When one is
left, scan matching gets a map of all scans so far, and the step brings relative poses to them, by which the graph
corrects the steps before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridlio.cloud.deskew import deskew
from hybridlio.cloud.voxel import voxel_pick
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import (
    LEVEL_SINE,
    MEAN_ACCELERATION_SIGMA_M_S2,
    POINT_LEVER_M,
    UNKNOWN_SPEED_SIGMA_M_S,
)
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.odometry.inertial_motion import inertial_motion
from hybridlio.odometry.start.motion_spread import MOST_SCANS, MotionSpread
from hybridlio.registration.base_motion import BaseMotion
from hybridlio.registration.cost_profile import PROBE_STEP_M
from hybridlio.registration.joint_motion import SIZE, JointMotion, JointPoints, JointProblem
from hybridlio.sources.settings import ScanMatchingSettings

_LEAST_SCANS = 4  # with four, all of 54 starts in six recordings were right to 7 cm
_LONGEST_S = 2.0  # over which one acceleration and one rate of turn describe what the IMU does not
# Rise of the cost over its scatter at which a motion is dropped: that of an observed direction
# (hybridlio/registration/cost_profile.py). From three scans on: the minima of two are where they like.
_DROPPED_RATIO = 4.5
_DROPPING_SCANS = 3
# Of the squared normalised change of the scan before by a new one, and scans in a row below it. The first scans of a
# lidar of few rings have a flat valley of costs, in which the minimum still moves by ten standard deviations.
_SETTLED, _SETTLED_SCANS = chi_square_quantile(0.99, 6), 2
_FEW_JUDGED, _JUDGED = 500, 2000  # points to compare starts, some hundreds of a scan; and to find each minimum
_COARSE_STEPS, _FINE_STEPS = 6, 5  # the kernel is halved from 1 m to 0.1 m in four
_MOST_MOTIONS = 6
# On the variance of independent residuals: that of scan matching, doubled. In the 54 starts above the squared
# normalised error per axis was 1.6 with scan matching's.
_SHARED_ERROR_SCALE = 2.0


@dataclass(frozen=True, eq=False)
class StartEstimate:
    """What is known of the motion after a scan.

    Attributes:
        relative: the step to it. Once decided it carries the poses relative to all scans before.
        frames: all frames so far, compensated by that motion.
        poses: ``(K, 4, 4)`` their lidar poses in the frame of the first.
        covariance: ``(6, 6)`` of the last, as if the motion had settled.
        is_decided: whether one motion is left, and the scans observe it in every direction.
        is_last: whether the search ends here even if undecided.
    """

    relative: RelativePose
    frames: list[Frame]
    poses: Array
    covariance: Array
    is_decided: bool
    is_last: bool


class StartSearch:
    """Searches the motion through the first scans.

    Attributes:
        last: the last estimate.

    Args:
        first: the first frame, as recorded.
        settings: of scan matching, at the scale of its scene.
        calibration: the extrinsics.
        noise: the IMU's.
        repeats: whether the lidar repeats its pattern from scan to scan.
        leads: whether its steps are those of the run until it has decided.
    """

    NOT_STATE = ("_settings", "_calibration", "_noise", "_repeats")

    def __init__(
        self,
        first: Frame,
        settings: ScanMatchingSettings,
        calibration: Calibration,
        noise: ImuNoise,
        repeats: bool,
        leads: bool,
    ) -> None:
        self.leads, self._repeats = leads, repeats
        self._settings, self._calibration, self._noise = settings, calibration, noise
        self._frames = [first]
        self._motions: list[JointMotion] = []
        self._settled = 0  # scans in a row that left the one before where it was
        self.last: StartEstimate | None = None

    def add(self, frame: Frame, start: State, source: str) -> StartEstimate | None:
        """Take the next frame and return what is known now; None if it cannot take part.

        Args:
            frame: as recorded.
            start: the backend's state at the first frame.
            source: name of the residual source, for the step.
        """
        base = self._base(frame, start) if self._has_points_in_time(frame) else None
        if base is None:
            return None
        self._frames.append(frame)
        problem = self._problem(base)
        self._motions = self._minima(problem)
        is_last = len(self._frames) >= MOST_SCANS
        is_unique = len(self._motions) == 1 and len(self._frames) >= _LEAST_SCANS
        slowest = min(range(len(self._motions)), key=lambda i: float(np.linalg.norm(self._motions[i].motion[3:6])))
        chosen = 0 if is_last else slowest
        poses = [base.poses_beside(one.motion) for one in self._motions]
        unsettled = self._unsettled(poses[chosen])
        self._settled = 0 if self.last is None or unsettled.any() else self._settled + 1
        is_decided = is_unique and self._settled >= _SETTLED_SCANS
        is_decided = is_decided and self._is_observed(problem, self._motions[0], poses[0], start)
        spread = MotionSpread(base.stamps_ns, base.times_s, self._motions, poses, chosen)
        motion = self._motions[chosen]
        self.last = StartEstimate(
            replace(
                replace(spread, unsettled=unsettled).step(source, is_decided or is_last),
                details={"motions": float(len(self._motions)), "cost": float(motion.costs.mean())},
            ),
            [replace(one, scan=base.compensated(one.scan, k, motion.motion)) for k, one in enumerate(self._frames)],
            poses[chosen],
            spread.covariance(0, len(self._frames) - 1),
            is_decided,
            is_last,
        )
        return self.last

    def _has_points_in_time(self, frame: Frame) -> bool:
        since_s = (frame.scan.stamp_ns - self._frames[0].scan.stamp_ns) / NS_PER_S
        return len(frame.scan) >= self._settings.min_points and since_s < _LONGEST_S

    def _base(self, last: Frame, start: State) -> BaseMotion | None:
        """Return the motion by the IMU that starts and ends at the origin; None where its samples have gaps."""
        first, after = self._frames[0], [*self._frames[1:], last]
        before = first.sweep_imu.between(first.scan.stamp_ns - NS_PER_S, first.scan.stamp_ns)
        samples = ImuSamples.concatenate([before, *(frame.imu for frame in after), last.sweep_imu])
        motion = None
        if start.has_imu and len(samples) and samples.stamps_ns[0] <= start.stamp_ns:
            motion = inertial_motion(samples, start, np.eye(4), last.scan.stamp_ns, self._calibration)
        return None if motion is None else BaseMotion(motion, [frame.scan.stamp_ns for frame in (first, *after)])

    def _problem(self, base: BaseMotion) -> JointProblem:
        parts = []
        for k, frame in enumerate(self._frames):
            points = deskew(frame.scan, base.motion).points.astype(np.float64)
            ranges2 = np.einsum("ij,ij->i", points, points)
            kept = np.flatnonzero((ranges2 > self._settings.min_range_m**2) & (ranges2 < self._settings.max_range_m**2))
            kept = kept[voxel_pick(points[kept], self._settings.source_voxel_m)]
            parts.append(base.place(frame.scan, points, k, kept))
        sigmas = np.r_[
            np.full(3, self._noise.gyro_bias_sigma_rad_s),
            np.full(3, UNKNOWN_SPEED_SIGMA_M_S),
            np.full(3, MEAN_ACCELERATION_SIGMA_M_S2),  # of gravity's direction
        ]
        scale = _SHARED_ERROR_SCALE * self._settings.covariance_scale
        return JointProblem(JointPoints.concatenate(parts), self._settings.registration, sigmas, scale)

    def _starts(self, problem: JointProblem) -> list[Array]:
        """Return motions to start from: at first the best of all speeds, later those that are left, and rest."""
        if self._motions:
            return [*(motion.motion for motion in self._motions), np.zeros(SIZE)]
        beside = abs(self._settings.start_speeds_m_s[1])
        speeds = [(speed, 0.0) for speed in self._settings.start_speeds_m_s[::2]]
        speeds += [(-beside, 0.0), (0.0, beside), (0.0, -beside)]
        starts = [np.r_[np.zeros(3), ahead, left, np.zeros(4)] for ahead, left in speeds]
        widest_m = self._settings.registration.max_distance_m
        return sorted(starts, key=lambda start: problem.cost(start, widest_m))[:_MOST_MOTIONS]

    def _minima(self, problem: JointProblem) -> list[JointMotion]:
        """Return distinct minima that are not significantly worse than the best, the best first."""
        count, settings = len(problem.points.times_s), self._settings.registration
        coarse, fine = (problem.with_stride(max(1, count // judged)) for judged in (_FEW_JUDGED, _JUDGED))
        starts = self._starts(coarse)
        found = self._distinct([coarse.solve(start, settings.max_distance_m, _COARSE_STEPS) for start in starts])
        found = [fine.solve(one.motion, 2 * settings.kernel_m, _FINE_STEPS) for one in found[:_MOST_MOTIONS]]
        found = self._distinct(found)
        if len(self._frames) < _DROPPING_SCANS:
            return found
        return [one for one in found if one.rise_over_scatter(found[0]) < _DROPPED_RATIO]

    def _unsettled(self, poses: Array) -> Array:
        """Return how fast ``(6,)`` a new scan has moved the one before; 0 where its covariance allows that."""
        if self.last is None:
            return np.zeros(6)
        since_s = (self._frames[-2].scan.stamp_ns - self._frames[0].scan.stamp_ns) / NS_PER_S
        moved = se3.log(se3.between(self.last.poses[-1], poses[-2]))
        is_allowed = moved @ np.linalg.solve(self.last.covariance, moved) < _SETTLED
        return np.zeros(6) if is_allowed else moved / since_s

    def _is_observed(self, problem: JointProblem, found: JointMotion, poses: Array, start: State) -> bool:
        """Return whether costs rise on both sides of the motion, along the direction that constrains it least."""
        last_s = float(problem.points.times_s.max())
        weakest = np.linalg.eigh(found.covariance[3:6, 3:6])[1][:, -1]
        if self._may_match_itself(weakest, poses, start):
            return False
        aside = np.r_[np.zeros(3), weakest * PROBE_STEP_M / last_s, np.zeros(3)]
        stride = max(1, len(problem.points.times_s) // _JUDGED)
        there = (problem.with_stride(stride).solve(found.motion + side * aside, 0.0, 0) for side in (-1, 1))
        return all(one.rise_over_scatter(found) > _DROPPED_RATIO for one in there)

    def _may_match_itself(self, direction: Array, poses: Array, start: State) -> bool:
        """Return whether a lidar's own pattern, which fits best where it has not moved, may hold it along a direction.

        As in registration to a single scan (:mod:`hybridlio.registration.degeneracy`), by less than half a metre a
        scan. Upwards it does not: speeds there are small, and walls show the turns that go with heights.
        """
        is_level = abs(direction @ start.up_in_lidar(self._calibration)) < LEVEL_SINE
        steps_m = np.abs(np.diff(poses[:, :3, 3], axis=0) @ direction)
        return bool(self._repeats and is_level and steps_m.max() < PROBE_STEP_M)

    def _distinct(self, found: list[JointMotion]) -> list[JointMotion]:
        """Return minima that put the last scan at different places, the lowest cost first."""
        last_s = (self._frames[-1].scan.stamp_ns - self._frames[0].scan.stamp_ns) / NS_PER_S
        out: list[JointMotion] = []
        for one in sorted(found, key=lambda motion: float(motion.costs.mean())):
            apart = (one.motion - other.motion for other in out)
            if all(_displacement_m(xi, last_s) > self._settings.registration.kernel_m for xi in apart):
                out.append(one)
        return out


def _displacement_m(motion: Array, time_s: float) -> float:
    shift = time_s * motion[3:6] + time_s**2 / 2 * motion[6:]
    return float(np.linalg.norm(shift) + POINT_LEVER_M * time_s * np.linalg.norm(motion[:3]))
