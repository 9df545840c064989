"""The inertial samples of a KITTI raw drive, from its 100 Hz recording and its 10 Hz rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.oxts import OxtsRows, read_oxts
from hybridlio.datasets.sequence import Notes
from hybridlio.datasets.stamps import note_coverage

_FILL_NS = 30_000_000  # a slow row is used where no fast one is this near: only in holes and beyond the ends

_SLOW_IMU = (
    "no 100 Hz inertial data: using the {rate:.0f} Hz rows of {folder}. That is about one sample a scan: what the car "
    "does between samples is interpolated and vibration is aliased into them, so motion predicted from them is less "
    "accurate. Put the drive's unsynchronised recording beside it, as {extract}, to use its 100 Hz"
)


def fast_rows(drive: Path) -> Path:
    """Where the 100 Hz rows of ``drive`` would lie: the ``oxts`` of its sibling ``*_extract`` folder."""
    return drive.with_name(drive.name.removesuffix("_sync") + "_extract") / "oxts"


def drive_imu(drive: Path, oxts: OxtsRows | None, notes: Notes) -> ImuSamples:
    """The inertial samples of a drive: 100 Hz from the sibling ``*_extract`` folder, else those of ``oxts``.

    Holes of the 100 Hz recording, and times before and after it, are filled from ``oxts``. Angular rates that are late
    against the attitudes, as KITTI's are, move to when they were (:func:`hybridlio.datasets.gyro_lag.gyro_lag_ns`).
    All that is noted.

    Raises:
        DataError: malformed rows, or 100 Hz rows on another clock than those of ``oxts``.
    """
    fast = fast_rows(drive)
    if fast.is_dir():
        return _filled(read_oxts(fast, notes), oxts, notes)
    if oxts is None:
        notes.add(f"no inertial data: neither {drive / 'oxts'} nor {fast} exists")
        return ImuSamples.empty()
    rate = 1e9 / float(np.median(np.diff(oxts.stamps_ns))) if len(oxts) > 1 else 0.0
    if rate < 50:
        notes.add(_SLOW_IMU.format(rate=rate, folder=drive / "oxts", extract=fast.parent.name))
    return _in_time(oxts, notes)


def _in_time(rows: OxtsRows, notes: Notes) -> ImuSamples:
    lag_ns = rows.gyro_lag_ns
    if lag_ns:
        notes.add(f"angular rates are {lag_ns / 1e6:.0f} ms late against the attitudes of the same rows; moved back")
    return rows.imu(lag_ns)


def _filled(rows: OxtsRows, slow_rows: OxtsRows | None, notes: Notes) -> ImuSamples:
    """The samples of ``rows``, with those of ``slow_rows`` where they have holes or do not reach."""
    fast = _in_time(rows, notes)
    if slow_rows is None:
        return fast
    note_coverage(rows.stamps_ns, slow_rows.stamps_ns, "100 Hz inertial data", notes, "navigation row")
    slow = slow_rows.imu(slow_rows.gyro_lag_ns)
    right = np.clip(np.searchsorted(fast.stamps_ns, slow.stamps_ns), 1, len(fast) - 1) if len(fast) > 1 else 0
    away = np.minimum(*(np.abs(slow.stamps_ns - fast.stamps_ns[k]) for k in (np.maximum(right - 1, 0), right)))
    use = away > _FILL_NS
    if not use.any():
        return fast
    notes.add(f"{int(use.sum())} of the slow navigation rows' samples fill holes and ends of the 100 Hz recording")
    stamps = np.concatenate([fast.stamps_ns, slow.stamps_ns[use]])
    order = np.argsort(stamps)
    gyro = np.concatenate([fast.gyro_rad_s, slow.gyro_rad_s[use]])[order]
    accel = np.concatenate([fast.accel_m_s2, slow.accel_m_s2[use]])[order]
    return ImuSamples(stamps[order], gyro, accel)
