"""The samples that compensate scans for motion while the offset between the clocks is still being found."""

from __future__ import annotations

import numpy as np

from hybridlio.calibration.clock_offset import ClockOffset
from hybridlio.calibration.imu_check import ImuCheck, moved
from hybridlio.core.sensors import ImuSamples

LARGEST_OFFSET_S = 0.2  # drivers that stamp on arrival are late by less; larger offsets are of clocks never set
_SETTLED_S = 2e-4  # a fifth of the accuracy that is wanted
_NEAR_S = 5e-4  # of two passes: farther apart, the line through them is not trusted
LARGEST_SHARE = 0.7  # of the compensation's offset in the one that is found; a hand that turns fast has 0.25 to 0.5
_CLEAR_S = 2e-3  # between two offsets, several times the noise of what is found with them
_COARSE_S = 0.02  # standard deviation of an offset that compensation begins with: as fine as the search and its step
_LARGEST_RATE_RAD_S = 6.0  # of 95 % of samples; rates beyond are of another unit and no help to compensate scans


class Compensation:
    """The samples that compensate scans for motion, on the scans' clock as far as it is known.

    The offset that is found depends on the one that scans are compensated with, and agrees with it where both are
    right. Each pass therefore goes to where the line through the last two would agree (secant method).
    """

    def __init__(self, imu: ImuSamples) -> None:
        rates = np.linalg.norm(imu.gyro_rad_s, axis=1)
        self.imu = imu if np.quantile(rates, 0.95) < _LARGEST_RATE_RAD_S else ImuSamples.empty()
        self.is_new = True
        self._offset_s = 0.0
        self._known_share: float | None = None
        self._before: tuple[float, float] | None = None  # offset of the compensation, and found with it

    def is_far_off(self, check: ImuCheck | None) -> bool:
        """Whether scans compensated with the first samples show no offset, so that others should be tried."""
        if not self.is_new or not len(self.imu):
            return False
        return check is None or (check.offset is not None and not _is_known_coarsely(check.offset))

    def shift(self, offset_s: float) -> None:
        """Start from another offset."""
        self.imu, self._offset_s, self.is_new = moved(self.imu, offset_s), offset_s, False

    def improve(self, check: ImuCheck) -> bool:
        """Take the offset and the bias that were found; return whether scans should be compensated again with them."""
        offset = check.offset
        if offset is None or check.wrong or not _is_known_coarsely(offset) or self.agrees(offset):
            return False
        used_s, found_s = self._offset_s, offset.offset_s
        next_s = used_s + (found_s - used_s) / (1 - self._share(found_s, 0.0))
        self._before, self.is_new = (used_s, found_s), False
        self._offset_s = float(np.clip(next_s, -LARGEST_OFFSET_S, LARGEST_OFFSET_S))
        to_come_s = self._offset_s - (found_s if offset.is_significant else 0.0)
        without_bias = check.imu.gyro_rad_s - offset.gyro_bias_rad_s
        self.imu = moved(ImuSamples(check.imu.stamps_ns, without_bias, check.imu.accel_m_s2), to_come_s)
        return True

    def agrees(self, offset: ClockOffset) -> bool:
        """Whether the offset that was found is the one that scans were compensated with."""
        is_near = abs(offset.offset_s - self._offset_s) < _NEAR_S
        return len(self.imu) > 0 and is_near and self.error_s(offset) < _SETTLED_S

    def error_s(self, offset: ClockOffset) -> float:
        """Return by how much the offset would still change if scans were compensated with it again and again."""
        share = self._share(offset.offset_s, LARGEST_SHARE)
        return abs(offset.offset_s - self._offset_s) * share / (1 - share) if len(self.imu) else 0.0

    def more_sigma_s(self, offset: ClockOffset) -> float:
        """Return the standard deviation that compensation adds to that of the offset.

        Where the offset that is found moves with the compensation's by a share ``s``, the error of the one at which
        both agree is that of a pass, divided by ``1 - s``.
        """
        share = self._share(offset.offset_s, 0.0)
        return float(np.hypot(self.error_s(offset), offset.sigma_s * np.sqrt((1 - share) ** -2.0 - 1)))

    def _share(self, found_s: float, unknown: float) -> float:
        """Return by how much of the compensation's offset the one that is found moves; ``unknown`` at first."""
        if self._before is not None and abs(self._offset_s - self._before[0]) > _CLEAR_S:
            share = (found_s - self._before[1]) / (self._offset_s - self._before[0])
            self._known_share = float(np.clip(share, 0.0, LARGEST_SHARE))
        return unknown if self._known_share is None else self._known_share


def _is_known_coarsely(offset: ClockOffset) -> bool:
    """Whether motion compensation is better with the offset that was found than without."""
    return not offset.contradicts and offset.sigma_s < _COARSE_S
