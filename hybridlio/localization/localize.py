"""Localise a recording in a map that was made before."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, EstimationError
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import Frame
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.localizer import LocalizationSettings, Localizer, MapPose
from hybridlio.localization.open_map import open_prior_map
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.result import Localization
from hybridlio.localization.start import Start, start_pose
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.record import Record
from hybridlio.runs.run import Run, adapt_config, run_odometry
from hybridlio.smoothing.step_uncertainty import drift_of

_log = logging.getLogger(__name__)
_Z = np.array([0.0, 0.0, 1.0])


class MapOdometry:
    """An odometry whose scans are also localised in a map. Its estimates are the odometry's own.

    Args:
        odometry: a new odometry.
        prior: the map.
        start: where the first scan is; None to find it by the map's places.
        settings: of localisation.

    Attributes:
        poses: of every scan so far in the map, None while its place is not known.
    """

    def __init__(
        self,
        odometry: Odometry,
        prior: PriorMap,
        start: Start | None = None,
        settings: LocalizationSettings | None = None,
    ) -> None:
        self._odometry, self._prior, self._start = odometry, prior, start
        self.localizer = Localizer(prior, settings)
        self.settings = self.localizer.settings
        self.poses: list[MapPose | None] = []

    def step(self, frame: Frame) -> Estimate:
        """Estimate the frame's pose, and where it is in the map."""
        estimate, odometry = self._odometry.step(frame), self._odometry
        if odometry.last_scan is None or estimate.step is None or estimate.relative is None:
            self.poses = [None]
            return estimate
        up = self._up(frame, estimate)
        if self._start is not None:
            self.localizer.start(start_pose(self._prior, odometry.last_scan, up, self._start), estimate.pose)
            self._start = None
        self.poses.append(self.localizer.step(odometry.last_scan, estimate.pose, estimate.relative, up))
        return estimate

    def _up(self, frame: Frame, estimate: Estimate) -> Array:
        """Up ``(3,)`` in the odometry's world, the first scan's frame."""
        state, calibration = self._odometry.last_state, frame.calibration
        if state is None or not state.has_imu or calibration is None:
            return _Z
        return np.asarray(estimate.pose[:3, :3] @ state.up_in_lidar(calibration))

    def record(self, scans: int | None = None) -> Record:
        """Return the odometry's record."""
        return self._odometry.record(scans)

    def state(self, row: int = 0) -> dict[str, Any] | None:
        """Return the odometry's state."""
        return self._odometry.state(row)

    def resume(self, done: Iterable[tuple[Frame, Estimate]], state: Mapping[str, Any]) -> float:
        """Bring the odometry to where another one was; localisation begins anew."""
        return self._odometry.resume(done, state)


def localize(
    sequence: Sequence,
    prior: PriorMap | str | Path,
    start: Start | None = None,
    config: Config | None = None,
    *,
    settings: LocalizationSettings | None = None,
    progress: Progress | None = None,
) -> Localization:
    """Localise a recording in a map.

    Odometry predicts each pose in the map, and every scan is matched with the map, which holds the pose where enough of
    the scan fits. Where it does not, because the map ends or the place has changed, odometry goes on alone with growing
    covariance until the map holds again.

    Args:
        sequence: the recording.
        prior: the map: of :func:`hybridlio.localization.open_map.open_prior_map`, or its path.
        start: ``(x, y, yaw)`` of the first scan in the map, metres and radians, within a few metres and ten degrees;
            by default the place is recognised, and believed when several scans confirm it.
        config: settings of the odometry.
        settings: of localisation.
        progress: called after each scan.

    Raises:
        ConfigError: ``sequence`` is no recording.
        DataError: the map cannot be read.
        EstimationError: the recording's place in the map was not found.
    """
    if not isinstance(sequence, Sequence):
        raise ConfigError(
            f"localize takes a recording, got {type(sequence).__name__}; hl.open_sequence(path) opens one"
        )
    prior = prior if isinstance(prior, PriorMap) else open_prior_map(prior)
    config = adapt_config(sequence, config or Config())
    followed = MapOdometry(Odometry(config=config), prior, start, settings)
    run = run_odometry(sequence, followed, progress)
    if run.stopped is not None and len(run.estimates) < 2:
        raise run.stopped
    return localization_of(run, followed)


def localization_of(run: Run, followed: MapOdometry) -> Localization:
    """Return the result of a run whose odometry is ``followed``.

    Raises:
        EstimationError: the recording's place in the map was not found.
    """
    poses = followed.poses[: len(run.estimates)]
    found = next((k for k, one in enumerate(poses) if one is not None and one.held), None)
    if found is None:
        raise EstimationError(
            f"{run.sequence.name}: its place in the map was not found in {len(poses)} scans; give a start (x, y, yaw) "
            "within a few metres if it is known, or a map of this place"
        )
    estimates = list(run.estimates)
    known = [one for one in poses[found:] if one is not None]
    before = _backwards(estimates[: found + 1], known[0].at, followed.settings.odometry_scale)
    placed = [*before, *(one.at for one in known)]
    trajectory = Trajectory(
        np.array([e.stamp_ns for e in estimates]),
        np.array([one.pose for one in placed]),
        np.array([one.covariance for one in placed]),
    )
    matches = [None if one is None else one.match for one in poses]
    return Localization(
        trajectory,
        np.array([one is not None and one.held for one in poses]),
        np.array([np.nan if m is None else m.matched for m in matches]),
        np.array([np.nan if m is None else m.cost for m in matches]),
        found,
        run,
    )


def _backwards(estimates: list[Estimate], at: UncertainPose, odometry_scale: float) -> list[UncertainPose]:
    """Return the poses in the map of the scans before the last of some, which is at a known pose."""
    out: list[UncertainPose] = []
    for before, after in zip(estimates[-2::-1], estimates[:0:-1], strict=True):
        step = se3.between(after.pose, before.pose)
        assert after.relative is not None
        drift = se3.rotate_covariance(odometry_scale * drift_of(after.relative), se3.inverse(step))
        at = at.moved(step, drift)
        out.insert(0, at)
    return out
