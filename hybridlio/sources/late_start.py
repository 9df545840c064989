"""The first scan of a run whose IMU wakes up after it.

The world is the lidar's frame at the first scan's stamp, and every later pose is relative to it. How the lidar moved
between that stamp and the first sample is a guess at first. The first scan that samples cover whole does not depend on
it. It starts the map anew, and the first scan is placed relative to it together with the guess's error
(:mod:`hybridlio.registration.sweep_registration`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridlio.cloud.voxel import voxel_pick
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import BRIDGED_ACCELERATION_SIGMA_M_S2, POINT_LEVER_M, UNKNOWN_RATE_SIGMA_RAD_S
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples
from hybridlio.core.start_state import rate_change, turn_beyond_linear_rates
from hybridlio.registration.surface import Surface
from hybridlio.registration.sweep_registration import Sweep, SweepPose, register_sweep
from hybridlio.sources import map_errors
from hybridlio.sources.settings import ScanMatchingSettings

# Of the guessed velocity: that of a step between two scans which are both distorted by a decimetre.
_SPEED_SIGMA_M_S = 1.0
# Samples of two scans show about one change of each axis' rate. The variance of a new one is that of three values times
# 3, as that of Student's t with three degrees of freedom.
_FEW_CHANGES = np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class LateStart:
    """The first scan, as long as samples have not covered a scan.

    Attributes:
        frame: as recorded.
        compensated: by a guess.
    """

    frame: Frame
    compensated: Frame

    def noise(self, samples: ImuSamples) -> Array:
        """Return the covariance ``(6, 6)`` of the motion between the first scan's stamp and most of its points."""
        without_s = self.without_s(samples)
        turn = _FEW_CHANGES * rate_change(samples, self._lag_s(samples)) * without_s / 2
        shift = BRIDGED_ACCELERATION_SIGMA_M_S2 * without_s**2 / 2
        return np.diag(np.r_[np.full(3, turn), np.full(3, shift)] ** 2)

    def noise_without_samples(self) -> Array:
        """Return the same covariance ``(6, 6)`` before any sample has come: the motion of anything.

        A sweep that is compensated by a wrong turn is displaced as well, by about a third of its points' displacement.
        """
        turn = UNKNOWN_RATE_SIGMA_RAD_S * self.duration_s / 2
        return np.diag(np.r_[np.full(3, turn), np.full(3, turn * POINT_LEVER_M / 3)] ** 2)

    def noise_of_speed(self, before: State) -> Array:
        """Return the covariance ``(6, 6)`` of where most points of a covered sweep lie, by that of the speed."""
        variance = np.trace(before.covariance[6:9, 6:9]) / 3 * (self.duration_s / 2) ** 2
        return np.diag(np.r_[np.zeros(3), np.full(3, variance)])

    def without_s(self, samples: ImuSamples) -> float:
        """Return for how long the sweep has no samples after its stamp."""
        return min(self._late_s(samples), self.duration_s)

    @property
    def duration_s(self) -> float:
        """Time from the stamp to the sweep's last point."""
        assert self.frame.scan.time_offsets_ns is not None
        return float(self.frame.scan.time_offsets_ns.max()) / NS_PER_S

    def _late_s(self, samples: ImuSamples) -> float:
        return max(float(samples.stamps_ns[0] - self.frame.scan.stamp_ns) / NS_PER_S, 0.0)

    def _lag_s(self, samples: ImuSamples) -> float:
        """Return over which time a rate changed that is known by samples, or by the step between two scans."""
        return min(self._late_s(samples), 2 * self.duration_s)

    def placed(
        self,
        settings: ScanMatchingSettings,
        surface: Surface | None,
        samples: ImuSamples,
        T_scan_first: Array,
        lost_cost: float,
    ) -> SweepPose | None:
        """Place the first scan relative to a covered one; None if it does not fit, or if samples cover it, too.

        Args:
            settings: of scan matching.
            surface: of the covered scan; None where it makes no planes.
            samples: the first of the IMU.
            T_scan_first: ``(4, 4)`` a guess.
            lost_cost: mean cost from which the first scan does not fit.
        """
        lag_s, without_s = self._lag_s(samples), self.without_s(samples)
        if surface is None or without_s == 0:
            return None
        change = _FEW_CHANGES * rate_change(samples, lag_s)
        at_end = rate_change(samples, 0.0) if lag_s <= without_s else change
        points = self.compensated.scan.points.astype(np.float64)
        range2 = np.einsum("ij,ij->i", points, points)
        kept = np.flatnonzero((range2 > settings.min_range_m**2) & (range2 < settings.max_range_m**2))
        kept = kept[voxel_pick(points[kept], settings.map_voxel_m)]
        assert self.frame.scan.time_offsets_ns is not None
        times_s = self.frame.scan.time_offsets_ns[kept] / NS_PER_S
        speeds = (_SPEED_SIGMA_M_S, _SPEED_SIGMA_M_S)
        sweep = Sweep(points[kept], times_s, without_s, (change, at_end), speeds)
        scale = settings.covariance_scale * map_errors.inflation(1, is_dense=False)
        found = register_sweep(surface, sweep, T_scan_first, settings.registration, scale)
        if found.matched < settings.min_matched or found.cost > lost_cost:
            return None
        beyond_rad = _FEW_CHANGES * turn_beyond_linear_rates(samples, without_s)
        return replace(found, covariance=found.covariance + np.diag(np.r_[np.full(3, beyond_rad), np.zeros(3)] ** 2))

    @staticmethod
    def first_samples(frame: Frame) -> ImuSamples:
        """Return the samples of a step and of the sweep at its end."""
        return ImuSamples.concatenate([frame.imu, frame.sweep_imu])


def starts_late(first: Frame) -> bool:
    """Return whether samples that motion compensation needs are missing at the first scan's stamp.

    A first sample within a period of the stamp is not late.
    """
    offsets_ns = first.scan.time_offsets_ns
    if first.calibration is None or offsets_ns is None or not len(offsets_ns) or offsets_ns.max() <= 0:
        return False
    return first.sweep_imu.starts_after(first.scan.stamp_ns)


def less_certain(step: RelativePose, noise: Array) -> RelativePose:
    """Return the first step with noise that all later poses share."""
    return replace(step.wider(added=noise), drift=None if step.drift is None else step.drift + noise)
