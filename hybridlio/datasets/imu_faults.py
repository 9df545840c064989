"""Inertial samples that nobody measured: spikes, and gaps that were filled with a straight line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from hybridlio.core.sensors import NS_PER_S, ImuSamples

_AROUND = 5  # samples
_SPIKE_RAD_S, _SPIKE_M_S2 = 5.0, 80.0  # off the median of those around: more than a car does, or a hand
_MOST_SPIKES = 0.01  # of all samples; more of them are no spikes
_LONGEST_LINE_S = 0.2  # a vehicle's vibration and the sensor's noise never lie on a line for so long
_LEAST_SAMPLES = 8
_OFF_THE_LINE = 0.05  # of the typical deviation from the neighbours' line


def spikes(imu: ImuSamples) -> NDArray[np.intp]:
    """Rows of samples far off the median of those around: bits that fell over, overflows, a knock on the sensor.

    One alone turns or throws the predicted motion by metres. Where over one in a hundred is so far off it is something
    else, such as another unit, and none is named.
    """
    if len(imu) < _AROUND:
        return np.empty(0, np.intp)
    off = [
        np.abs(values - median_filter(values, size=(_AROUND, 1), mode="mirror")).max(axis=1)
        for values in (imu.gyro_rad_s, imu.accel_m_s2)
    ]
    found = np.flatnonzero((off[0] > _SPIKE_RAD_S) | (off[1] > _SPIKE_M_S2))
    return found if len(found) <= max(1, _MOST_SPIKES * len(imu)) else found[:0]


def without_spikes(imu: ImuSamples) -> tuple[ImuSamples, NDArray[np.int64]]:
    """The samples without :func:`spikes`, and the stamps of these."""
    rows = spikes(imu)
    return _those(imu, np.delete(np.arange(len(imu)), rows)) if len(rows) else imu, imu.stamps_ns[rows]


def filled_gaps(imu: ImuSamples) -> list[tuple[int, int]]:
    """First and last row of every stretch in which all six channels run along straight lines.

    Real samples scatter about the line between their neighbours by the sensor's noise. A stretch counts where it lasts
    over 0.2 s and no channel is off the line by more than a twentieth of what is typical of it. Where a channel has no
    noise, as in a simulation of none, nothing is found.
    """
    if len(imu) < 2 * _LEAST_SAMPLES:
        return []
    times = (imu.stamps_ns - imu.stamps_ns[0]) / NS_PER_S
    values = np.hstack([imu.gyro_rad_s, imu.accel_m_s2])
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    off = np.abs(values[1:-1] - (1 - share) * values[:-2] - share * values[2:])
    typical = np.median(off, axis=0)
    # steps of a sensor's own resolution, or no noise at all, look like lines everywhere
    if (typical <= 1e-9 * np.abs(values).max(axis=0)).any():
        return []
    on_line = (off < _OFF_THE_LINE * typical).all(axis=1)
    ends = np.flatnonzero(np.diff(np.r_[0, on_line.astype(np.int8), 0]))
    runs = [(int(a), int(b) + 1) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return [(a, b) for a, b in runs if b - a >= _LEAST_SAMPLES and times[b] - times[a] > _LONGEST_LINE_S]


def without_filled_gaps(imu: ImuSamples) -> tuple[ImuSamples, list[tuple[int, int]]]:
    """The samples that were measured, and the times ``(start_ns, end_ns)`` in which the others lay.

    The ends of a line are real.
    """
    keep: NDArray[np.bool_] = np.ones(len(imu), dtype=bool)
    gaps = filled_gaps(imu)
    for first, last in gaps:
        keep[first + 1 : last] = False
    return _those(imu, keep), [(int(imu.stamps_ns[a]), int(imu.stamps_ns[b])) for a, b in gaps]


def _those(imu: ImuSamples, rows: NDArray[np.bool_] | NDArray[np.intp]) -> ImuSamples:
    return ImuSamples(imu.stamps_ns[rows], imu.gyro_rad_s[rows], imu.accel_m_s2[rows])
