"""Localisation scan by scan: odometry predicts the pose in the map, and matches with the map correct it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Scan
from hybridlio.core.setting_checks import check_positive, check_setting
from hybridlio.localization.confirmation import Confirmation, ConfirmationSettings, Vote
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.map_matching import MapMatch, MapMatchingSettings, match_with_map
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.recent_path import RecentPath
from hybridlio.localization.view_places import ViewPlaces
from hybridlio.record.loop_keyframes import LoopKeyframeSettings
from hybridlio.smoothing.loop_verification import VerificationSettings
from hybridlio.smoothing.places import levelling_rotations
from hybridlio.smoothing.step_uncertainty import drift_of
from hybridlio.sources.scene_scale import scale_of, scaled
from hybridlio.sources.settings import ScanMatchingSettings
from hybridlio.sources.thinned_scan import ThinnedScan, thin


@dataclass(frozen=True)
class LocalizationSettings:
    """Settings of localisation.

    Attributes:
        matching: of each scan with the map.
        confirmation: when a place is believed.
        thinning: how scans are thinned, as in scan matching.
        keyframes: which scans are recognised as places.
        odometry_scale: factor on odometry's covariances; 4 allows for errors of twice the claimed size, such as those
            that consecutive steps share, as in loop closure.
        inlier_share: share of correct matches that lie within the bound of the prediction.
        sure_m: where the position is less certain than this, a match must be confirmed by others. Within it a
            registration has one minimum (the kernel starts at most a metre wide).

    Raises:
        SettingError: a value is out of range.
    """

    matching: MapMatchingSettings = field(default_factory=MapMatchingSettings)
    confirmation: ConfirmationSettings = field(default_factory=ConfirmationSettings)
    thinning: ScanMatchingSettings = field(default_factory=ScanMatchingSettings)
    keyframes: LoopKeyframeSettings = field(default_factory=LoopKeyframeSettings)
    odometry_scale: float = 4.0
    inlier_share: float = 0.999
    sure_m: float = 0.5

    def __post_init__(self) -> None:
        check_positive(self, "odometry_scale", "sure_m")
        check_setting(self, "inlier_share", 0 < self.inlier_share < 1, "above 0 and below 1")

    def at_scale(self, scale: float) -> LocalizationSettings:
        """Return the settings for scenes of a scale: below 1, in rooms, lengths shrink."""
        if scale == 1.0:
            return self
        thinning, keyframes, confirmation = scaled(self.thinning, scale), self.keyframes, self.confirmation
        return replace(
            self,
            matching=replace(self.matching, scale=scale, registration=thinning.registration),
            thinning=thinning,
            keyframes=replace(keyframes, spacing_m=scale * keyframes.spacing_m, voxel_m=scale * keyframes.voxel_m),
            confirmation=replace(
                confirmation,
                distance_m=scale * confirmation.distance_m,
                max_difference_m=scale * confirmation.max_difference_m,
            ),
            sure_m=scale * self.sure_m,
        )


@dataclass(frozen=True, eq=False)
class MapPose:
    """Where a scan is in the map.

    Attributes:
        at: pose and covariance.
        held: whether the map held the pose: the scan was matched with it. Else odometry carried it on.
        match: the match, also one that did not hold; None where there is no map.
    """

    at: UncertainPose
    held: bool
    match: MapMatch | None = None


class Localizer:
    """Follows a run through a map.

    Until the start is known, :meth:`step` returns None. The start is given, or found by place recognition, and then
    believed only when several scans, metres apart, agree.

    Args:
        prior: the map.
        settings: limits.
    """

    def __init__(self, prior: PriorMap, settings: LocalizationSettings | None = None) -> None:
        self._given = prior, settings or LocalizationSettings()
        self._scale = 0.0
        self._use(1.0)
        self._bound = chi_square_quantile(self.settings.inlier_share, 6)
        self.forget()

    def forget(self) -> None:
        """Forget the run, as before another one: its start is given or found anew. What is known of the map is kept."""
        self._has_begun = False
        self._last: UncertainPose | None = None
        self._last_pose: Array | None = None
        self._is_given = False  # the user vouches for a given start, until the map holds
        self._travelled_m = 0.0
        self._held_at_m = -np.inf

    def _use(self, scale: float) -> None:
        """Take map and settings for scenes of a scale, and collect keyframes and votes anew."""
        if scale != self._scale:
            prior, settings = self._given
            self._scale, self._prior, self.settings = scale, prior.at_scale(scale), settings.at_scale(scale)
            self._views = ViewPlaces(self._prior.surface, self._prior.up, self.settings.matching)
        self._confirmation = Confirmation(self.settings.confirmation)
        self._path = RecentPath(self.settings.keyframes, scale * VerificationSettings().reach_m)

    def start(self, at: UncertainPose, pose: Array) -> None:
        """Begin at a pose in the map.

        Args:
            at: of a scan, ``T_map_lidar``.
            pose: ``(4, 4)`` ``T_world_lidar`` of the odometry there.
        """
        self._last, self._last_pose, self._is_given = at, pose, True

    def step(self, scan: Scan, pose: Array, step: RelativePose, up: Array) -> MapPose | None:
        """Localise a scan; None while its place in the map is not known.

        Args:
            scan: motion compensated.
            pose: ``(4, 4)`` ``T_world_lidar`` of the odometry.
            step: the odometry's step from the last scan.
            up: ``(3,)`` in the odometry's world.
        """
        if not self._has_begun:
            self._use(scale_of(thin(scan, self._given[1].thinning).view_m))
            self._has_begun = True
        predicted = self._predict(pose, step)
        is_keyframe = self._path.add(scan, pose, step)
        match, thinned = None, thin(scan, self.settings.thinning)
        if predicted is not None:
            is_vague = predicted.sigma_m > self.settings.sure_m
            match = match_with_map(self._prior.surface, thinned, predicted, self.settings.matching, is_vague)
            self._last, held = self._corrected(predicted, match)
            if held:
                return self._hold(self._last, match)
        if is_keyframe and self._is_lost and (found := self._recognised(thinned, pose, up)) is not None:
            return self._hold(found, match)
        return None if self._last is None else MapPose(self._last, False, match)

    def _hold(self, at: UncertainPose, match: MapMatch | None) -> MapPose:
        """Take a pose that the map holds."""
        self._last, self._held_at_m, self._is_given = at, self._travelled_m, False
        self._confirmation.clear()
        return MapPose(at, True, match)

    @property
    def _is_lost(self) -> bool:
        """Whether places are to be recognised: no match has held over the path that a confirmation takes."""
        return self._travelled_m - self._held_at_m > self.settings.confirmation.distance_m

    def _predict(self, pose: Array, step: RelativePose) -> UncertainPose | None:
        """Return the pose predicted by odometry, None while the start is unknown."""
        before, self._last_pose = self._last_pose, pose
        if before is None:
            return self._last
        moved, drift = se3.between(before, pose), self.settings.odometry_scale * drift_of(step)
        self._travelled_m += float(np.linalg.norm(moved[:3, 3]))
        self._confirmation.move(moved, drift)
        return None if self._last is None else self._last.moved(moved, drift)

    def _corrected(self, predicted: UncertainPose, match: MapMatch | None) -> tuple[UncertainPose, bool]:
        """Return the pose after a match, and whether the match holds it."""
        if match is None or not match.holds or predicted.chi2(match.found) > self._bound:
            return predicted, False
        found: UncertainPose | None = match.found
        if predicted.sigma_m > self.settings.sure_m and not self._is_given:
            found = self._confirmed(match.found)
        return (predicted, False) if found is None else (predicted.fused(found), True)

    def _confirmed(self, found: UncertainPose) -> UncertainPose | None:
        """Return the pose that enough scans agree on; None before."""
        return self._confirmation.add(Vote(found, self._travelled_m))

    def _recognised(self, scan: ThinnedScan, pose: Array, up: Array) -> UncertainPose | None:
        """Return the pose in the map by place recognition, once confirmed."""
        confirmed = (self._confirmed(one) for one in self._candidates(scan, pose, up))
        return next((one for one in confirmed if one is not None), None)

    def _candidates(self, scan: ThinnedScan, pose: Array, up: Array) -> list[UncertainPose]:
        """Return where the scan, a keyframe, may be: by the places of the map, or by its views."""
        places = self._prior.places
        if places is None:
            match = self._views.recognise(scan, levelling_rotations(pose[None], up)[0])
            return [] if match is None else [match.found]
        around = self._path.places(up)
        found = places.recognise(around, len(around) - 1)
        return [UncertainPose(places.poses[one.place] @ one.verdict.pose, one.verdict.covariance) for one in found]
