"""The classical residual source: registration of each scan to the last one, or to a map of recent keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import MEASUREMENT_FLOOR_SIGMAS, POINT_LEVER_M, UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.registration.degeneracy import RegistrationProblem, register_with_degeneracy
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.motion_search import best_start, coarse_kernel_m, fits_better, starts_after
from hybridlio.registration.results import LONG_ADRIFT, ObservedRegistration
from hybridlio.sources import map_errors
from hybridlio.sources.gate.position_doubt import NEW_MAP
from hybridlio.sources.matching_state import MatchingState, PathPoint
from hybridlio.sources.recent_points import RecentPoints
from hybridlio.sources.refinding import REFOUND_COST, has_unknown_turn, has_vague_start, starts_within
from hybridlio.sources.settings import ScanMatchingSettings
from hybridlio.sources.thinned_scan import SceneThinning, ThinnedScan, thin

LOST_COST = 0.6  # mean cost of the points that the map covers; well above that of any scan that is placed correctly
# A new map starts after this number of scans in a row that have enough points and do not fit. A passing occlusion lasts
# less than half a second at 10 Hz; bridging longer adds more error than a new map, which starts at the bridges' error.
_LOST_SCANS = 5
_FLOOR_COVARIANCE = np.diag(MEASUREMENT_FLOOR_SIGMAS**2)


class ScanMatching:
    """Registers each scan, starting from its initial pose.

    The source follows a path of its own, which starts at the first scan. The backend's corrections do not move it: a
    map that jumped would not fit the scans in it.

    Args:
        settings: how scans are matched.
    """

    name = "scan-matching"
    NOT_STATE = ("_before",)

    def __init__(self, settings: ScanMatchingSettings | None = None) -> None:
        self._scene = SceneThinning(settings or ScanMatchingSettings())
        self._map, self._covered = LocalMap(self.settings.local_map), np.inf
        self._state = MatchingState(PathPoint(np.eye(4)), PathPoint(np.eye(4)))
        self._stamp_ns = 0
        self._before = self._state, self._stamp_ns  # when the last scan came
        self.recent = RecentPoints()
        self.current_scan: ThinnedScan | None = None

    def start(self, frame: Frame) -> None:
        """Take the first scan, which becomes the map.

        Raises:
            DataError: it has too few points.
        """
        scan = self._scene.thin_first(frame.scan)
        if len(scan.points) < self.settings.min_points:
            raise DataError(
                f"frame {frame.index}: only {len(scan.points)} points between {self.settings.min_range_m:.2g} "
                f"and {self.settings.max_range_m:g} m; start at a scan with at least {self.settings.min_points}"
            )
        self._map = LocalMap(self.settings.local_map)
        self._state = MatchingState.started(scan.points)
        self.recent = self.recent.emptied()
        self.recent.observe(frame.scan)
        self.recent.add(scan.points, np.eye(4))
        self.current_scan, self._stamp_ns = scan, frame.scan.stamp_ns

    def start_from(self, frames: Sequence[Frame], poses: Array) -> None:
        """Start at the last of two or more scans with known poses ``(K, 4, 4)``; the map is made of all of them.

        Raises:
            DataError: the first scan has too few points.
        """
        self.start(frames[0])
        for frame, pose in zip(frames[1:], poses[1:], strict=True):
            self.recent.observe(frame.scan)
            self.current_scan = scan = self._thin(frame.scan)
            self.recent.add(scan.points, pose)
        dt_s = (frames[-1].scan.stamp_ns - frames[-2].scan.stamp_ns) / NS_PER_S
        together = self.recent.together(scan.points, poses[-1], self.settings.map_voxel_m)
        self._state = MatchingState.placed(poses[-2], poses[-1], dt_s, together)
        self._stamp_ns = frames[-1].scan.stamp_ns

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Register the scan; where that fails, return the initial pose with ``ok`` False."""
        self._insert_pending_keyframe()
        self.recent.observe(frame.scan)
        self._before = self._state, self._stamp_ns
        return self._match(frame, self._thin(frame.scan, initial.from_imu), initial)

    def refine_again(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Register the last scan, which matched, once more as it is compensated now, in place of that match."""
        self._state, self._stamp_ns = self._before
        self.recent.discard_last()
        return self._match(frame, thin(frame.scan, self.settings), initial)

    def _match(self, frame: Frame, scan: ThinnedScan, initial: RelativePose) -> RelativePose:
        """Register a thinned scan, or bridge it where that fails."""
        self.current_scan = scan
        dt_s, self._stamp_ns = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S, frame.scan.stamp_ns
        usable = len(scan.points) >= self.settings.min_points and self._map.surface is not None
        coverage = self._covered / max(len(scan.points), 1)
        observed = self._register(scan, initial, dt_s).within_coverage(coverage) if usable else None
        if observed is None or observed.registration.matched < self.settings.min_matched:
            return self._bridge(scan, initial, observed)
        return self._accept(scan, initial, observed, dt_s)

    @property
    def settings(self) -> ScanMatchingSettings:
        """The settings at the scene's scale."""
        return self._scene.settings

    @property
    def _weighs_predictions(self) -> bool:
        """Whether matches are weighed with the IMU's predictions along weak directions: of lidars that do not repeat.

        A spinning lidar's minima err alike, on the same few trunks: weighed so, drift in a field is a third larger.
        """
        return not self.recent.repeats

    def _thin(self, scan: Scan, has_imu: bool = False) -> ThinnedScan:
        """Thin a scan at the scene's scale, which it may change; the map then goes on at the new one."""
        before = self.settings
        thinned = self._scene.thin(scan, has_imu)
        if self.settings is not before:
            self._map.rescale(self.settings.local_map)
        return thinned

    def take_back(self, initial: RelativePose) -> None:
        """Discard the last match: the path continues by ``initial``, and the scan does not enter the map."""
        self.recent.discard_last()
        self._state = self._state.taken_back(initial)

    def pair(self, earlier: ThinnedScan, current: ThinnedScan, initial: RelativePose) -> RelativePose:
        """Return ``T_j_k`` of the current scan in the earlier one, registered to it alone from ``initial``.

        Both are values of :attr:`current_scan`. Where registration fails, ``initial`` is returned with ``ok`` False.
        """
        too_few = min(len(earlier.points), len(current.points)) < self.settings.min_points
        if too_few or earlier.surface is None:
            return replace(initial, ok=False)
        settings = self.settings.registration
        kernel_start_m = min(max(settings.kernel_m, initial.translation_sigma_m), settings.max_distance_m)
        problem = RegistrationProblem(earlier.surface, current.source, settings, current.points, np.eye(4))
        observed = register_with_degeneracy(problem, initial.pose, kernel_start_m)
        if observed.registration.matched < self.settings.min_matched:
            return replace(initial, ok=False)
        pose, covariance = observed.registration.pose, self._covariance(observed, current, keyframes=1)
        return RelativePose(pose, covariance, self.name, degenerate=observed.degenerate)

    def _accept(
        self, scan: ThinnedScan, initial: RelativePose, observed: ObservedRegistration, dt_s: float
    ) -> RelativePose:
        """Move the state on to the pose found and return the step to it."""
        before, unobserved = self._state.current, observed.degenerate
        observed, adrift = self._state.believed(observed, has_vague_start(initial), is_dense=self.recent.repeats)
        pose, weak = self._weighed(observed, initial)
        self._state = self._state.matched(pose, dt_s, unobserved, adrift, weak)
        self.recent.add(scan.points, pose)
        if self._follows_last_scan:
            self._state = self._state.keyframe_pending(scan.points)
        elif self._map.needs_keyframe(pose) or self.recent.is_filling:
            filled = self.recent.together(scan.points, pose, self.settings.map_voxel_m)
            self._state = self._state.keyframe_pending(filled)
        covariance = self._covariance(observed, scan, self._keyframes)
        drift = self._drift(covariance, before.map_changed)
        if drift is None:  # the scan it is matched to lies before those that were bridged
            covariance = covariance + before.bridge_covariance
        step = se3.between(before.T_map_lidar, pose)
        details = {"points": float(len(scan.points)), **observed.registration.diagnostics}
        return RelativePose(step, covariance, self.name, drift=drift, degenerate=observed.degenerate, details=details)

    def _weighed(self, observed: ObservedRegistration, initial: RelativePose) -> tuple[Array, Array]:
        """Return the pose found and its covariance along weak directions, weighed with the IMU's prediction or not."""
        if not (initial.from_imu and self._weighs_predictions):
            return observed.registration.pose, np.zeros((6, 6))
        before = self._state.current
        return observed.weighed_with(before.T_map_lidar @ initial.pose, before.predicted_covariance(initial))

    def _bridge(self, scan: ThinnedScan, initial: RelativePose, observed: ObservedRegistration | None) -> RelativePose:
        """Move the state on by the initial pose and return that pose as a failed step."""
        before = self._state.current
        self._state = self._state.bridged(initial, scan.points if self._map.surface is None else None)  # no planes yet
        added = initial.covariance if initial.from_imu else self._state.current.added_since(before, initial)
        drift = self._drift(_FLOOR_COVARIANCE, map_changed=False)
        details = {"points": float(len(scan.points)), **(observed.registration.diagnostics if observed else {})}
        self._state = replace(self._state, unmatched=self._state.unmatched + (observed is not None))
        if self._state.unmatched >= _LOST_SCANS:
            # the new map lies beside the old one by the error of all bridges since the last match
            drift = None if drift is None else self._state.current.bridge_covariance
            self._state = self._state.restarted(scan.points)
            details[NEW_MAP] = 1.0
        return RelativePose(
            initial.pose, added, initial.source,
            ok=False, from_imu=initial.from_imu, drift=drift, details=details,
        )  # fmt: skip

    @property
    def _follows_last_scan(self) -> bool:
        """Whether the map is the last scan alone: by the settings, or as no other scan's position is known."""
        return self.settings.target == "last-scan" or self._state.adrift > 0

    @property
    def _keyframes(self) -> int:
        """Number of keyframes in the map, with the pending one."""
        return 1 if self.settings.target == "last-scan" else self._map.keyframes + (self._state.keyframe is not None)

    def _covariance(self, observed: ObservedRegistration, scan: ThinnedScan, keyframes: int) -> Array:
        is_dense = map_errors.is_dense(scan.measured, self.settings.least_measured, self.recent.repeats)
        is_dense = is_dense and not self._follows_last_scan  # a single scan errs as one
        return observed.covariance(self.settings.covariance_scale * map_errors.inflation(keyframes, is_dense))

    def _drift(self, covariance: Array, map_changed: bool) -> Array | None:
        """Return the part of a step's covariance that adds up over steps; None if all of it does."""
        if self.settings.target == "last-scan" or self._state.adrift >= LONG_ADRIFT:
            return None
        least, repeats = self.settings.drift_share, self.recent.repeats
        return map_errors.drift_share(map_changed, self._keyframes, least, repeats) * covariance

    def _insert_pending_keyframe(self) -> None:
        """Insert the last scan into the map if it is a keyframe; otherwise use the time to rebuild the map if due."""
        if self._state.keyframe is None:
            self._map.rebuild_if_due()
            return
        if self._follows_last_scan:
            self._map = LocalMap(self.settings.local_map)
        keyframe, pose = self._state.keyframe, self._state.current.T_map_lidar
        self._map.insert(keyframe, pose)
        self._covered = self._map.covered(keyframe, pose, self.settings.registration.max_distance_m)
        self._state = self._state.keyframe_inserted()

    def _register(self, scan: ThinnedScan, initial: RelativePose, dt_s: float) -> ObservedRegistration:
        """Register the scan to the map from wherever its motion is known best."""
        start = (place := self._state.current.bridged_by(initial)).T_map_lidar
        is_unknown = initial.translation_sigma_m > UNKNOWN_TRANSLATION_SIGMA_M
        is_lost = self._state.current.bridged and place.sigma_m > coarse_kernel_m(self.settings.registration)
        if is_lost and not is_unknown:
            return self._continue_motion(self._state.last_found, scan, dt_s) or self._refind(scan, place)
        if is_unknown:  # the initial-pose source knows no motion, but this source may know the last one
            continued = self._continue_motion(self._state.current, scan, dt_s)
            if continued is not None and continued.registration.cost < REFOUND_COST:
                return continued
            given = (settings := self.settings).start_speeds_m_s, settings.start_rates_deg_s, dt_s
            starts = starts_after(self._state.current.T_map_lidar, initial.pose, *given, has_unknown_turn(initial))
            start = best_start(self._problem(scan).surface, scan.source, scan.points, starts, settings.registration)
        observed = self._register_from(start, scan, initial)
        if observed.registration.matched < self.settings.min_matched:  # a faulty IMU's initial pose is wrong
            return self._continue_motion(self._state.last_found, scan, dt_s) or observed
        return observed

    def _refind(self, scan: ThinnedScan, place: PathPoint) -> ObservedRegistration:
        """Register from the best start in the bridges' region; a scan that fits nowhere there has no matches."""
        problem = self._problem(scan)
        starts = starts_within(place.T_map_lidar, place.bridge_covariance, problem.settings.max_distance_m)
        start = best_start(problem.surface, scan.source, scan.points, starts, problem.settings)
        observed = register_with_degeneracy(problem, start, coarse_kernel_m(problem.settings), is_start_vague=True)
        fits = observed.registration.cost < REFOUND_COST
        return observed if fits else replace(observed, registration=replace(observed.registration, matched=0.0))

    def _continue_motion(self, last: PathPoint, scan: ThinnedScan, dt_s: float) -> ObservedRegistration | None:
        """Register from where the last motion leads; None if that is unknown or the scan does not fit there."""
        if last.twist is None or self._map.surface is None:
            return None
        settings, start = self.settings, last.T_map_lidar @ se3.exp(last.twist * dt_s)
        kernel_m = coarse_kernel_m(settings.registration)
        observed = register_with_degeneracy(self._problem(scan), start, kernel_m, is_start_vague=True)
        found = observed.registration
        return observed if found.matched >= settings.min_matched and found.cost < LOST_COST else None

    def _register_from(self, start: Array, scan: ThinnedScan, initial: RelativePose) -> ObservedRegistration:
        """Register from ``start``, or from the proposed pose if the scan fits the map better there."""
        problem = self._problem(scan, is_vague := has_vague_start(initial))
        surface, settings = problem.surface, problem.settings
        sideways_m = POINT_LEVER_M * float(np.sqrt(initial.covariance[:3, :3].trace()))
        # beyond the distance within which points are matched, a wider kernel has no effect
        kernel_start_m = min(max(settings.kernel_m, initial.translation_sigma_m, sideways_m), settings.max_distance_m)
        if initial.proposed is not None:
            proposed = self._state.current.T_map_lidar @ initial.proposed
            if fits_better(surface, scan.source, proposed, start, kernel_start_m, settings.threads):
                observed = register_with_degeneracy(problem, proposed, kernel_start_m, is_vague)
                if not observed.weak_basis.shape[1]:  # along weakly constrained directions the initial pose knows more
                    return observed
        return register_with_degeneracy(problem, start, kernel_start_m, is_vague)

    def _problem(self, scan: ThinnedScan, is_start_vague: bool = True) -> RegistrationProblem:
        surface, only, has_rings = self._map.surface, self._map.only_keyframe_pose, self.recent.repeats
        assert surface is not None
        has_planes = surface.one_sided and has_rings and only is None and not is_start_vague
        of_scan = scan.source, self.settings.registration, scan.points
        return RegistrationProblem(surface, *of_scan, only, not has_rings, has_planes)
