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

    def steps(self, start_ns: int, end_ns: int) -> tuple[list[int], list[Values]]:
        """Return stamps and values from ``start_ns`` to ``end_ns``, interpolated at both ends, as lists for speed.

        Behind the newest sample its values are held.
        """
        first, last = bisect_right(self._stamps, start_ns), bisect_left(self._stamps, end_ns)
        stamps = [start_ns, *self._stamps[first:last], end_ns]
        return stamps, [self._at(start_ns), *self._values[first:last], self._at(end_ns)]

    def _at(self, stamp_ns: int) -> Values:
        after = bisect_left(self._stamps, stamp_ns)
        if after == len(self) or after == 0 or self._stamps[after] == stamp_ns:
            return self._values[min(after, len(self) - 1)]
        before_ns, after_ns = self._stamps[after - 1 : after + 1]
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        ends = zip(self._values[after - 1], self._values[after], strict=True)
        return tuple(a + share * (b - a) for a, b in ends)

    def _rows(self, first: int, last: int) -> ImuSamples:
        table = np.array(self._values[first:last], dtype=np.float64).reshape(-1, 6)
        return ImuSamples(np.array(self._stamps[first:last], dtype=np.int64), table[:, :3], table[:, 3:])
