"""The classical residual source: registration of each scan to the last one, or to a map of recent keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.voxel import voxel_average, voxel_pick
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import (
    MEASUREMENT_FLOOR_SIGMAS,
    UNKNOWN_TRANSLATION_SIGMA_M,
    VAGUE_TRANSLATION_SIGMA_M,
)
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.registration.degeneracy import ObservedRegistration, RegistrationProblem, register_with_degeneracy
from hybridlio.registration.icp import Registration
from hybridlio.registration.local_map import LocalMap, LocalMapSettings
from hybridlio.registration.motion_search import COARSE_KERNEL_M, best_start, fits_better, motions
from hybridlio.registration.surface import Surface
from hybridlio.sources.scan_matching_settings import ScanMatchingSettings

_UNSURE_ROTATION_RAD = 0.02
_LEVER_M = 10.0  # half of the points are nearer: what an unsure rotation moves them by
_LOST_COST = 0.6  # of the points' cost between 0 and 1: well above any that lie where they should
_SHARE_OF_SAME_MAP = 1e-3
_FINER = 0.7  # voxel, where few points are measured
_NEVER_FEW = 4  # times what is needed: of a scan of so many points at least a quarter is always registered
_YOUNG_MAP = 5.0  # a map of one keyframe has ground only along that scan's rings, and guesses what lies between
_FLOOR_COVARIANCE = np.diag(MEASUREMENT_FLOOR_SIGMAS**2)


@dataclass(eq=False)
class _Path:
    """Where the source's own path has come to.

    Attributes:
        T_map_lidar: ``(4, 4)`` the last scan's pose.
        twist: ``(6,)`` a second, of the last step; None where it is not known.
        bridged: whether the last scan's pose is a guess.
        unsure: ``(6, 6)`` of the steps since the last scan that was matched.
        map_changed: whether the map has taken in a keyframe since that one.
    """

    T_map_lidar: Array
    twist: Array | None = None
    bridged: bool = False
    unsure: Array = field(default_factory=lambda: np.zeros((6, 6)))
    map_changed: bool = False

    def carried_on(self, initial: RelativePose) -> _Path:
        """One step farther, as ``initial`` guesses it."""
        unsure = se3.compose_covariance(self.unsure, initial.pose, initial.covariance)
        return _Path(self.T_map_lidar @ initial.pose, None, True, unsure, self.map_changed)


@dataclass(eq=False)
class SeenScan:
    """A scan as it is matched: ``points`` ``(N, 3)`` thinned for the map, ``source`` ``(M, 3)`` for registration."""

    points: Array
    source: Array
    settings: LocalMapSettings

    @cached_property
    def surface(self) -> Surface | None:
        """The scan alone as something to register to, in its own frame."""
        alone = LocalMap(self.settings)
        alone.insert(self.points, np.eye(4))
        return alone.surface


class ScanMatching:
    """Registers each scan from its initial pose. Its own path starts at the first scan and is never sent back to it."""

    name = "scan-matching"

    def __init__(self, settings: ScanMatchingSettings | None = None) -> None:
        self._settings = settings or ScanMatchingSettings()
        self._map = LocalMap(self._settings.local_map)
        self._path = _Path(np.eye(4))
        self._before = self._path
        self._doubted: _Path | None = None  # where the last scan was found, which the IMU contradicts
        self._waiting: Array | None = None  # points of a keyframe that goes into the map before the next scan
        self._adrift = False  # nobody knows how far the last scan is from the map: another map starts there
        self._stamp_ns = 0
        self.seen: SeenScan | None = None

    def start(self, frame: Frame) -> None:
        """Make the first scan the map.

        Raises:
            DataError: it has too few points.
        """
        seen = self._look(frame.scan)
        if len(seen.points) < self._settings.min_points:
            raise DataError(
                f"frame {frame.index}: only {len(seen.points)} points between {self._settings.min_range_m} and "
                f"{self._settings.max_range_m} m; start at a scan with at least {self._settings.min_points}"
            )
        self._map = LocalMap(self._settings.local_map)
        self._path = self._before = _Path(np.eye(4), map_changed=True)
        self._doubted = None
        self._waiting, self.seen = seen.points, seen
        self._stamp_ns = frame.scan.stamp_ns

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Register the scan; where that fails, return the initial pose marked as not ok."""
        self._take_in_keyframe()
        self.seen = seen = self._look(frame.scan)
        dt_s = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S
        self._stamp_ns = frame.scan.stamp_ns
        usable = len(seen.points) >= self._settings.min_points and self._map.surface is not None
        observed = self._register(seen, initial, dt_s) if usable else None
        if observed is None or observed.registration.matched < self._settings.min_matched:
            if self._map.surface is None:  # nothing could be made of the scans so far
                self._waiting = seen.points
            return self._bridge(initial, len(seen.points), observed)
        found = observed.registration
        before, self._before = self._path, self._path
        step = se3.between(before.T_map_lidar, found.pose)
        left_open = bool(len(observed.degenerate))
        last = self._doubted or (None if before.bridged else before)
        twist = None if last is None or left_open else se3.log(se3.between(last.T_map_lidar, found.pose)) / dt_s
        self._path, self._doubted = _Path(found.pose, twist), None
        self._adrift = left_open and _is_vague(initial)
        if self._settings.target == "last-scan" or self._adrift or self._map.needs_keyframe(found.pose):
            self._waiting, self._path.map_changed = seen.points, True
        return self._answer(step, observed, before, len(seen.points))

    def take_back(self, initial: RelativePose) -> None:
        """Leave the last scan out: the path goes on by ``initial``, and the map stays as it was."""
        self._waiting, self._doubted = None, self._path
        self._path = self._before.carried_on(initial)

    def pair(self, earlier: SeenScan, current: SeenScan, initial: RelativePose) -> RelativePose:
        """A scan relative to an earlier one alone, ``T_j_k``, from about ``initial``; that, not ok, where it fails."""
        few = min(len(earlier.points), len(current.points)) < self._settings.min_points
        if few or earlier.surface is None:
            return replace(initial, ok=False)
        settings, sigma_m = self._settings.registration, initial.translation_sigma_m
        wide = min(max(settings.kernel_m, sigma_m), 1.0)
        problem = RegistrationProblem(earlier.surface, current.source, settings, current.points, np.eye(4))
        observed = register_with_degeneracy(problem, initial.pose, wide)
        if observed.registration.matched < self._settings.min_matched:
            return replace(initial, ok=False)
        covariance = self._covariance(observed, 1)
        return RelativePose(observed.registration.pose, covariance, self.name, degenerate=observed.degenerate)

    def _answer(self, step: Array, observed: ObservedRegistration, before: _Path, points: int) -> RelativePose:
        covariance = self._covariance(observed, self._keyframes)
        drift = self._drift(covariance, before.map_changed)
        if drift is None:
            covariance = covariance + before.unsure  # the scan it is matched to lies before those that were bridged
        return RelativePose(
            step,
            covariance,
            source=self.name,
            drift=drift,
            degenerate=observed.degenerate,
            details=_details(observed.registration, points),
        )

    @property
    def _keyframes(self) -> int:
        """Those of the map, with the one that waits."""
        if self._settings.target == "last-scan":
            return 1
        return self._map.keyframes + (self._waiting is not None)

    def _covariance(self, observed: ObservedRegistration, keyframes: int) -> Array:
        return observed.covariance(self._settings.covariance_scale * (1 + _YOUNG_MAP / keyframes))

    def _drift(self, covariance: Array, map_changed: bool) -> Array | None:
        """What of a step's covariance adds up: at first much, for a map of few keyframes is as wrong as they are."""
        if self._settings.target == "last-scan":
            return None
        share = max(self._settings.drift_share, 0.5 / self._keyframes) if map_changed else _SHARE_OF_SAME_MAP
        return share * covariance

    def _look(self, scan: Scan) -> SeenScan:
        """The scan's points within range, one a voxel, and a share of the same to register."""
        points = voxel_average(scan.points, None, self._settings.map_voxel_m)[0].astype(np.float64)
        points = np.asarray(points[self._in_range(points)])
        return SeenScan(points, self._to_register(points, scan), self._settings.local_map)

    def _to_register(self, points: Array, scan: Scan) -> Array:
        """Some of the points, one a voxel; the less each is the mean of, the more of them it takes."""
        side_m, finest_m = self._settings.source_voxel_m, self._settings.map_voxel_m / 2
        picked = voxel_pick(points, side_m)
        if len(scan) < _NEVER_FEW * self._settings.least_measured:
            measured = np.count_nonzero(self._in_range(scan.points)) / max(len(points), 1)  # for each of the points
            while measured * len(picked) < self._settings.least_measured and side_m > finest_m:
                side_m *= _FINER
                picked = voxel_pick(points, side_m)
        return points.take(picked, axis=0)

    def _in_range(self, points: Array | Floats) -> NDArray[np.bool_]:
        range2 = np.einsum("ij,ij->i", points, points)
        near, far = self._settings.min_range_m, self._settings.max_range_m
        return np.asarray((range2 > near**2) & (range2 < far**2))

    def _take_in_keyframe(self) -> None:
        """Put a keyframe that was not taken back into the map."""
        if self._waiting is None:
            self._map.rebuild_if_due()
            return
        if self._settings.target == "last-scan" or self._adrift:
            self._map = LocalMap(self._settings.local_map)
        self._map.insert(self._waiting, self._path.T_map_lidar)
        self._waiting = None

    def _register(self, seen: SeenScan, initial: RelativePose, dt_s: float) -> ObservedRegistration:
        surface, settings = self._map.surface, self._settings.registration
        assert surface is not None
        sigma_m = initial.translation_sigma_m
        sideways_m = _LEVER_M * float(np.sqrt(initial.covariance[:3, :3].trace()))
        kernel_start_m = min(max(settings.kernel_m, sigma_m, sideways_m), 1.0)
        start = self._path.T_map_lidar @ initial.pose
        if sigma_m > UNKNOWN_TRANSLATION_SIGMA_M:
            # who guesses no motion leaves it to this source to know the last one
            if (observed := self._going_on(self._path, seen, dt_s)) is not None:
                return observed
            turns = initial.covariance[:3, :3].trace() > _UNSURE_ROTATION_RAD**2
            rates_deg_s = self._settings.start_rates_deg_s if turns else (0.0,)
            starts = [start @ step for step in motions(self._settings.start_speeds_m_s, rates_deg_s, dt_s)]
            start = best_start(surface, seen.source, seen.points, starts, settings)
        observed = self._from_the_better(seen, start, initial, kernel_start_m)
        if observed.registration.matched < self._settings.min_matched:  # such as by an IMU that is wrong
            return self._going_on(self._doubted or self._path, seen, dt_s) or observed
        return observed

    def _going_on(self, last: _Path, seen: SeenScan, dt_s: float) -> ObservedRegistration | None:
        """Registered from where the last motion leads; None where that is not known, or the scan lies badly there."""
        settings = self._settings
        if last.twist is None or self._map.surface is None:
            return None
        moving = last.T_map_lidar @ se3.exp(last.twist * dt_s)
        observed = register_with_degeneracy(self._problem(seen), moving, COARSE_KERNEL_M, is_start_vague=True)
        lies_well = observed.registration.matched >= settings.min_matched and observed.registration.cost < _LOST_COST
        return observed if lies_well else None

    def _from_the_better(
        self, seen: SeenScan, start: Array, initial: RelativePose, kernel_start_m: float
    ) -> ObservedRegistration:
        """Register from ``start``, or from what was proposed, where the points lie better on the map there."""
        problem, is_vague = self._problem(seen), _is_vague(initial)
        if initial.proposed is not None:
            proposed, threads = self._path.T_map_lidar @ initial.proposed, problem.settings.threads
            if fits_better(problem.surface, seen.source, proposed, start, kernel_start_m, threads):
                observed = register_with_degeneracy(problem, proposed, kernel_start_m, is_vague)
                if not observed.weak_basis.shape[1]:  # the initial pose knows more of what the points hardly see
                    return observed
        return register_with_degeneracy(problem, start, kernel_start_m, is_vague)

    def _problem(self, seen: SeenScan) -> RegistrationProblem:
        surface = self._map.surface
        assert surface is not None
        settings, only = self._settings.registration, self._map.only_keyframe_pose
        return RegistrationProblem(surface, seen.source, settings, seen.points, only)

    def _bridge(self, initial: RelativePose, points: int, observed: ObservedRegistration | None) -> RelativePose:
        self._before, self._path, self._doubted = self._path, self._path.carried_on(initial), None
        return RelativePose(
            initial.pose,
            initial.covariance,
            source=initial.source,
            ok=False,
            drift=self._drift(_FLOOR_COVARIANCE, map_changed=False),  # the map has not moved
            from_imu=initial.from_imu,
            details=_details(observed.registration, points) if observed else {"points": float(points)},
        )


def _is_vague(pose: RelativePose) -> bool:
    """So that a map by such poses would show everything several times."""
    return pose.translation_sigma_m > VAGUE_TRANSLATION_SIGMA_M


def _details(found: Registration, points: int) -> dict[str, float]:
    return {
        "points": float(points),
        "matched": found.matched,
        "iterations": float(found.iterations),
        "converged": float(found.converged),
        "sigma_m": found.sigma_m,
        "cost": found.cost,
    }
