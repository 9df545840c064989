"""IMU samples of the last seconds, in order of time whatever the order of arrival."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from hybridlio.core.sensors import ImuSamples

Values = tuple[float, ...]  # angular velocity, then specific force


class ImuBuffer:
    """IMU samples in order of time."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[Values] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, values: Values) -> bool:
        """Add a sample; return False if there is one with its stamp, which then stays."""
        at = len(self._stamps)
        if self._stamps and stamp_ns <= self._stamps[-1]:
            at = bisect_left(self._stamps, stamp_ns)
            if self._stamps[at] == stamp_ns:
                return False
        self._stamps.insert(at, stamp_ns)
        self._values.insert(at, values)
        return True

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the samples before a stamp, except the last of them, from which to interpolate."""
        count = bisect_right(self._stamps, stamp_ns) - 1
        if count > 0:
            del self._stamps[:count], self._values[:count]

    def around(self, start_ns: int, end_ns: int) -> ImuSamples:
        """Return the samples from ``start_ns`` to ``end_ns`` and one beyond each end.

        :meth:`ImuSamples.between` and :meth:`ImuSamples.during` give the same from these as from all samples.
        """
        first, last = bisect_right(self._stamps, start_ns) - 1, bisect_left(self._stamps, end_ns) + 1
        return self._rows(max(first, 0), last)

    def last_before(self, stamp_ns: int) -> int | None:
        """Return the stamp of the last sample at or before ``stamp_ns``."""
        at = bisect_right(self._stamps, stamp_ns) - 1
        return self._stamps[at] if at >= 0 else None

    def until(self, start_ns: int, end_ns: int) -> ImuSamples:
        """Return the samples from ``start_ns`` to ``end_ns``, interpolated at both ends.

        Behind the newest sample its values are held until ``end_ns``.
        """
        first, last = bisect_left(self._stamps, start_ns), bisect_right(self._stamps, end_ns)
        newest = len(self) == last and last > 0
        if first < last and self._stamps[first] == start_ns and (newest or self._stamps[last - 1] == end_ns):
            rows = self._rows(first, last)
        else:
            rows = self.around(start_ns, end_ns).between(start_ns, end_ns)
        if not newest or self._stamps[-1] == end_ns:
            return rows
        stamps = [*rows.stamps_ns.tolist(), end_ns] if len(rows) else [start_ns, end_ns]
        values = np.hstack([rows.gyro_rad_s, rows.accel_m_s2]).tolist() if len(rows) else [self._values[-1]]
        return _samples(stamps, [*values, self._values[-1]])

    def _rows(self, first: int, last: int) -> ImuSamples:
        return _samples(self._stamps[first:last], self._values[first:last])


def _samples(stamps: list[int], values: list[Values]) -> ImuSamples:
    table = np.array(values, dtype=np.float64).reshape(-1, 6)
    return ImuSamples(np.array(stamps, dtype=np.int64), table[:, :3], table[:, 3:])
