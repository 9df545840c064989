"""Correction of the vertical angles in KITTI's scans.

KITTI's lidar reports every point about 0.2° too low. Flat ground then becomes a cone, and scans from two places do not
fit. The correction rotates each point about the horizontal axis perpendicular to its direction (Deschaud, "IMLS-SLAM:
scan-to-model matching based on 3D data", ICRA 2018).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets.notes import Notes

KITTI_VERTICAL_ANGLE_DEG = 0.205  # KISS-ICP's value; registration of two drives finds 0.18 to 0.20 (docs/results.md)

# digests of KITTI's calib_imu_to_velo.txt (the same on all dates) and of calib.txt's Tr (of 00-02, 03 and 04-21)
_KITTI_CALIBRATIONS = frozenset({"416e61ca9ac1b4ea", "eca64c0091f55929", "328069dfec6ced4f", "31474ac6c25ac7ea"})
_MAX_ANGLE_DEG = 5.0  # a larger error is not a calibration error: the angle is probably in another unit
_MAX_SCANS_TRIED = 5  # for one that can be read
_MIN_REFLECTANCES = 20  # distinct values in a scan; a constant column proves nothing, KITTI's scans have dozens
_ELEVATIONS_DEG = np.linspace(-20.0, 1.0, 1051)  # bins of 0.02°, within the lidar's field of view
_RANGE_M = (5.0, 60.0)  # horizontal; excludes the car itself and the few far points
_MIN_ELEVATION_SHARE = 0.5  # KITTI's scans have returns in 72 % or more of the bins, beams from one origin in 5 %


def raise_points(points: Floats, angle_deg: float) -> Floats:
    """Raise the elevation of points ``(N, 3)``, lidar frame, by ``angle_deg``; ranges and azimuths stay.

    A point on the vertical axis has no azimuth; only its height is scaled, by the cosine of the angle.
    """
    sine, cosine = np.float32(math.sin(math.radians(angle_deg))), np.float32(math.cos(math.radians(angle_deg)))
    x, y, z = np.ascontiguousarray(points.T, dtype=np.float32)
    across = np.sqrt(x * x + y * y)
    scale = cosine - sine * z / np.where(across > 0, across, np.float32(1))
    raised = np.empty((len(x), 3), np.float32)
    raised[:, 0], raised[:, 1], raised[:, 2] = x * scale, y * scale, z * cosine + across * sine
    return raised


@dataclass(frozen=True)
class RaisedScans:
    """Loads scans with points raised by ``angle_deg``. An object rather than a closure, so that it can be pickled."""

    load: Callable[[int], Scan]
    angle_deg: float

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``; raises the errors of ``load``."""
        scan = self.load(k)
        return replace(scan, points=raise_points(scan.points, self.angle_deg))


def raised(load: Callable[[int], Scan], angle_deg: float | None) -> Callable[[int], Scan]:
    """Return ``load`` with its points raised by ``angle_deg``; ``load`` itself for 0 or None.

    Raises:
        ConfigError: the angle is not finite or over 5°.
    """
    if angle_deg is None or angle_deg == 0:
        return load
    check_angle(angle_deg)
    return RaisedScans(load, angle_deg)


def check_angle(angle_deg: float) -> None:
    """Check a correction of the vertical angle.

    Raises:
        ConfigError: it is not finite or over 5°.
    """
    if not abs(angle_deg) <= _MAX_ANGLE_DEG:
        raise ConfigError(f"vertical_angle_deg: must be within ±{_MAX_ANGLE_DEG:.0f}°, got {angle_deg}")


def kitti_raised(
    load: Callable[[int], Scan], count: int, calibration: Array, angle_deg: float | None, notes: Notes
) -> Callable[[int], Scan]:
    """Return ``load`` with its points raised by ``angle_deg``, or by KITTI's error if the recording is KITTI's own.

    KITTI's own recordings have the numbers of KITTI's calibration, and scans that look like those of its lidar. Other
    recordings in the same layout are not changed.

    Args:
        load: loads scan ``k``.
        count: number of scans.
        calibration: ``(12,)``, the numbers of the calibration file.
        angle_deg: the correction, or None to decide by the recording.
        notes: receives a note of a correction that was not asked for.

    Raises:
        ConfigError: ``angle_deg`` is not finite or over 5°.
    """
    if angle_deg is not None or not _is_kitti_calibration(calibration) or not _is_kitti_lidar(load, count):
        return raised(load, angle_deg)
    notes.add(
        f"KITTI's own scans: points are raised by {KITTI_VERTICAL_ANGLE_DEG}° to correct the lidar's vertical angles; "
        "vertical_angle_deg=0 (--vertical-angle 0) turns this off"
    )
    return raised(load, KITTI_VERTICAL_ANGLE_DEG)


def _is_kitti_calibration(calibration: Array) -> bool:
    text = " ".join(f"{value:.6e}" for value in np.ravel(calibration))
    return hashlib.sha256(text.encode()).hexdigest()[:16] in _KITTI_CALIBRATIONS


def _is_kitti_lidar(load: Callable[[int], Scan], count: int) -> bool:
    """Return whether the first readable scan looks like KITTI's lidar, rather than a simulated one.

    The reflectances of KITTI's lidar are hundredths. Its lasers do not share one origin, so its points fill nearly all
    elevations, whereas those of a simulated lidar lie on one elevation per beam.
    """
    for k in range(min(count, _MAX_SCANS_TRIED)):
        try:
            scan = load(k)
        except DataError:
            continue
        x, y, z = scan.points.T
        across = np.hypot(x, y)
        far = (across > _RANGE_M[0]) & (across < _RANGE_M[1])
        seen = np.histogram(np.degrees(np.arctan2(z[far], across[far])), _ELEVATIONS_DEG)[0] > 0
        hundredths = 100 * (np.zeros(0) if scan.intensity is None else scan.intensity)
        whole = np.abs(hundredths - np.round(hundredths)) < 1e-3  # float32 rounding
        various = len(np.unique(hundredths)) >= _MIN_REFLECTANCES
        return bool(seen.mean() > _MIN_ELEVATION_SHARE and whole.all() and various)
    return False
