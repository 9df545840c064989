"""The IMU samples of a KITTI raw drive, from its 100 Hz recording and its 10 Hz navigation rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.kitti.gyro_lag import SLOW_ROWS_S
from hybridlio.datasets.kitti.oxts import OxtsRows, read_oxts
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import note_coverage

_FILL_NS = 30_000_000  # three samples of 100 Hz: a slow sample farther from any fast one fills a hole

_SLOW_IMU = (
    "no 100 Hz inertial data: using the {rate:.0f} Hz rows of {folder}, about one sample per scan. Motion between "
    "samples is interpolated and vibration is aliased, so predicted motion is less accurate. To use 100 Hz data, put "
    "the drive's unsynchronised recording beside it, as {extract}"
)


def fast_rows(drive: Path) -> Path:
    """Return where the 100 Hz rows of a drive are, if they exist: ``oxts`` in the sibling folder ``*_extract``."""
    return drive.with_name(drive.name.removesuffix("_sync") + "_extract") / "oxts"


def drive_imu(drive: Path, oxts: OxtsRows | None, notes: Notes) -> ImuSamples:
    """Return the IMU samples of a drive: the 100 Hz ones of :func:`fast_rows`, or those of ``oxts``.

    Holes in the 100 Hz recording, and times before and after it, are filled from ``oxts``. Angular rates that lag the
    attitudes, as KITTI's do, are shifted back (:func:`hybridlio.datasets.kitti.gyro_lag.gyro_lag_ns`). Each
    correction and substitute is noted.

    Args:
        drive: the drive's ``*_sync`` folder.
        oxts: the rows of the drive itself, or None.
        notes: receives the notes.

    Raises:
        DataError: the 100 Hz rows are malformed, or do not overlap those of ``oxts`` in time.
    """
    fast = fast_rows(drive)
    if fast.is_dir():
        return _filled(read_oxts(fast, notes), oxts, notes)
    if oxts is None:
        notes.add(f"no inertial data: neither {drive / 'oxts'} nor {fast} exists")
        return ImuSamples.empty()
    rate = NS_PER_S / float(np.median(np.diff(oxts.stamps_ns))) if len(oxts) > 1 else 0.0
    if rate < 1 / SLOW_ROWS_S:
        notes.add(_SLOW_IMU.format(rate=rate, folder=drive / "oxts", extract=fast.parent.name))
    return _without_lag(oxts, notes)


def _without_lag(rows: OxtsRows, notes: Notes) -> ImuSamples:
    lag_ns = rows.gyro_lag_ns
    if lag_ns:
        notes.corrected(f"angular rates lag the attitudes of the same rows by {lag_ns / 1e6:.0f} ms; shifted back")
    return rows.imu(lag_ns)


def _filled(rows: OxtsRows, slow_rows: OxtsRows | None, notes: Notes) -> ImuSamples:
    """Return the samples of ``rows``, with those of ``slow_rows`` in holes and beyond the ends."""
    fast = _without_lag(rows, notes)
    if slow_rows is None:
        return fast
    note_coverage(rows.stamps_ns, slow_rows.stamps_ns, "100 Hz inertial data", notes, "navigation row")
    slow = slow_rows.imu(slow_rows.gyro_lag_ns)
    right = np.clip(np.searchsorted(fast.stamps_ns, slow.stamps_ns), 1, len(fast) - 1) if len(fast) > 1 else 0
    distance = np.minimum(*(np.abs(slow.stamps_ns - fast.stamps_ns[k]) for k in (np.maximum(right - 1, 0), right)))
    use = distance > _FILL_NS
    if not use.any():
        return fast
    notes.corrected(f"{int(use.sum())} samples of the slow navigation rows fill holes and ends of the 100 Hz recording")
    stamps = np.concatenate([fast.stamps_ns, slow.stamps_ns[use]])
    order = np.argsort(stamps)
    gyro = np.concatenate([fast.gyro_rad_s, slow.gyro_rad_s[use]])[order]
    accel = np.concatenate([fast.accel_m_s2, slow.accel_m_s2[use]])[order]
    return ImuSamples(stamps[order], gyro, accel)
