"""IMU samples that were not measured: spikes, gaps that a recorder filled by linear interpolation, and clipped ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from hybridlio.core.arrays import Array, Mask, Stamps
from hybridlio.core.sensors import NS_PER_S, ImuSamples

_MEDIAN_WINDOW = 5  # samples: outvotes two spikes in a row
# Differences from the local median that neither a car nor a hand produces within two samples of 100 Hz: 5 rad/s in
# 20 ms is 250 rad/s², and 80 m/s² is 8 g.
_SPIKE_RAD_S, _SPIKE_M_S2 = 5.0, 80.0
_MAX_SPIKE_SHARE = 0.01  # of all samples; more are not transmission errors but, for example, another unit
_MIN_LINE_S = 0.2  # vibration and sensor noise never lie on a line for this long
_MIN_LINE_SAMPLES = 8  # by chance, a deviation below 1/20 of the median in 6 channels does not happen 8 times in a row
_LINE_SHARE = 0.05  # largest deviation from a line, relative to the channel's median deviation
_NO_NOISE = 1e-9  # median deviation, relative to the largest value, below which a channel has no noise
# Noise seldom repeats the largest value of a fine sensor, and reaches that of a coarse one by single steps. A clipped
# signal arrives at its limit from further off, and stays. Limits of sensors too coarse for that are not found.
_CLIPPED_RUN, _CLIPPED_STEPS = 3, 5


def spikes(imu: ImuSamples) -> NDArray[np.intp]:
    """Return the rows of samples far from the median of their neighbours: bit errors, overflows, a knock on the sensor.

    One spike shifts or turns the predicted motion by metres. If more than one sample in a hundred deviates this far,
    the cause is another (such as a wrong unit), and no row is returned.
    """
    if len(imu) < _MEDIAN_WINDOW:
        return np.empty(0, np.intp)
    deviation = [
        np.abs(values - median_filter(values, size=(_MEDIAN_WINDOW, 1), mode="mirror")).max(axis=1)
        for values in (imu.gyro_rad_s, imu.accel_m_s2)
    ]
    found = np.flatnonzero((deviation[0] > _SPIKE_RAD_S) | (deviation[1] > _SPIKE_M_S2))
    return found if len(found) <= max(1, _MAX_SPIKE_SHARE * len(imu)) else found[:0]


def without_spikes(imu: ImuSamples) -> tuple[ImuSamples, Stamps]:
    """Return the samples without :func:`spikes`, and the stamps of the spikes."""
    rows = spikes(imu)
    return _at_rows(imu, np.delete(np.arange(len(imu)), rows)) if len(rows) else imu, imu.stamps_ns[rows]


def filled_gaps(imu: ImuSamples) -> list[tuple[int, int]]:
    """Find gaps that were filled by linear interpolation.

    Real samples scatter about the line between their neighbours by the sensor's noise. A stretch counts as filled if it
    lasts over 0.2 s and all six channels stay within a twentieth of their median deviation from that line. Nothing is
    found if a channel has no noise, as in some simulations.

    Returns:
        The first and last row of every filled gap. These two rows are measured, those between them are not.
    """
    if len(imu) < 2 * _MIN_LINE_SAMPLES:
        return []
    times = (imu.stamps_ns - imu.stamps_ns[0]) / NS_PER_S
    values = np.hstack([imu.gyro_rad_s, imu.accel_m_s2])
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    deviation = np.abs(values[1:-1] - (1 - share) * values[:-2] - share * values[2:])
    typical = np.median(deviation, axis=0)
    # a channel quantised coarsely, or without noise, lies on lines everywhere
    if (typical <= _NO_NOISE * np.abs(values).max(axis=0)).any():
        return []
    on_line = (deviation < _LINE_SHARE * typical).all(axis=1)
    ends = np.flatnonzero(np.diff(np.r_[0, on_line.astype(np.int8), 0]))
    runs = [(int(a), int(b) + 1) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return [(a, b) for a, b in runs if b - a >= _MIN_LINE_SAMPLES and times[b] - times[a] > _MIN_LINE_S]


def without_filled_gaps(imu: ImuSamples) -> tuple[ImuSamples, list[tuple[int, int]]]:
    """Return the measured samples, and the gaps ``(start_ns, end_ns)`` that :func:`filled_gaps` found."""
    keep: Mask = np.ones(len(imu), dtype=bool)
    gaps = filled_gaps(imu)
    if not gaps:
        return imu, []
    for first, last in gaps:
        keep[first + 1 : last] = False
    return _at_rows(imu, keep), [(int(imu.stamps_ns[a]), int(imu.stamps_ns[b])) for a, b in gaps]


def clipped(values: Array) -> list[tuple[float, int]]:
    """Return the limits at which a sensor's signals ``(N, A)`` are cut off, and the number of samples there.

    A limit is the largest magnitude of an axis, repeated in three samples or more in a row, which the signal reaches or
    leaves by more than five of its smallest steps.
    """
    out = []
    for signal in values.T:
        distinct = np.unique(signal)
        if len(distinct) < _CLIPPED_STEPS:
            continue
        least_jump = _CLIPPED_STEPS * float(np.diff(distinct).min())
        for limit in (distinct[0], distinct[-1]):
            at_limit = signal == limit
            ends = np.flatnonzero(np.diff(np.r_[0, at_limit.astype(np.int8), 0]))
            padded = np.r_[limit, signal, limit]  # a run at either end of the recording has no jump there
            is_cut = any(
                b - a >= _CLIPPED_RUN and max(abs(padded[a] - limit), abs(padded[b + 1] - limit)) > least_jump
                for a, b in zip(ends[::2], ends[1::2], strict=True)
            )
            if is_cut:
                out.append((float(limit), int(at_limit.sum())))
    return out


def _at_rows(imu: ImuSamples, rows: Mask | NDArray[np.intp]) -> ImuSamples:
    return ImuSamples(imu.stamps_ns[rows], imu.gyro_rad_s[rows], imu.accel_m_s2[rows])
