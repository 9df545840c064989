"""The error of the vertical angles in KITTI's scans, and its correction.

KITTI's lidar delivers every point about 0.2° too low, so that flat ground bends into a cone and scans taken from two
places do not fit. The correction, a rotation of each point about the horizontal axis perpendicular to its direction, is
that of Deschaud, "IMLS-SLAM: scan-to-model matching based on 3D data", ICRA 2018; 0.205° is what KISS-ICP takes.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets.sequence import Notes

KITTI_VERTICAL_ANGLE_DEG = 0.205

# digests of what calib_imu_to_velo.txt (the same on all dates) and calib.txt's Tr (of 00-02, 03 and 04-21) hold
_KITTI_CALIBRATIONS = frozenset({"416e61ca9ac1b4ea", "eca64c0091f55929", "328069dfec6ced4f", "31474ac6c25ac7ea"})
_LARGEST_DEG = 5.0
_SCANS_TO_LOOK_AT = 5
_LEAST_REFLECTANCES = 20
_ELEVATIONS_DEG = np.linspace(-20.0, 1.0, 1051)
_SHARE_SEEN = 0.5  # KITTI's scans have returns at 72 % or more of these elevations, beams from one origin at 5 %


def raise_points(points: NDArray[np.float32], angle_deg: float) -> NDArray[np.float32]:
    """Points ``(N, 3)`` whose elevation seen from the sensor is ``angle_deg`` higher; ranges and azimuths stay.

    Points on the vertical axis have no azimuth to rotate along and only lose the cosine of their height.
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
    """Scans of ``load`` with every point raised by ``angle_deg``; an object, so that it can go to another process."""

    load: Callable[[int], Scan]
    angle_deg: float

    def __call__(self, k: int) -> Scan:
        """Scan ``k``; raises what ``load`` raises."""
        scan = self.load(k)
        return replace(scan, points=raise_points(scan.points, self.angle_deg))


def raised(load: Callable[[int], Scan], angle_deg: float | None) -> Callable[[int], Scan]:
    """``load`` with its points raised by ``angle_deg``; itself at 0 or None.

    Raises:
        ConfigError: the angle is not finite or over 5°.
    """
    if angle_deg is None or angle_deg == 0:
        return load
    check_angle(angle_deg)
    return RaisedScans(load, angle_deg)


def check_angle(angle_deg: float) -> None:
    """Check an angle to raise points by.

    Raises:
        ConfigError: it is not finite or over 5°.
    """
    if not abs(angle_deg) <= _LARGEST_DEG:
        raise ConfigError(f"vertical_angle_deg: {angle_deg} is no calibration error; give at most {_LARGEST_DEG:.0f}°")


def kitti_raised(
    load: Callable[[int], Scan], count: int, calibration: NDArray[np.float64], angle_deg: float | None, notes: Notes
) -> Callable[[int], Scan]:
    """``load`` with its points raised by ``angle_deg``, or where that is None by KITTI's error if it is there.

    Only KITTI's own recordings have it: those with the numbers of KITTI's ``calibration`` ``(12,)`` and with scans
    like its lidar's. Others in the same layout stay as they are.
    """
    if angle_deg is not None or not _is_kittis(calibration) or not _looks_like_kittis(load, count):
        return raised(load, angle_deg)
    notes.add(
        f"KITTI's own scans: points are raised by {KITTI_VERTICAL_ANGLE_DEG}° against the error of the lidar's "
        "vertical angles; vertical_angle_deg=0 (--vertical-angle 0) leaves them as they are"
    )
    return raised(load, KITTI_VERTICAL_ANGLE_DEG)


def _is_kittis(calibration: NDArray[np.float64]) -> bool:
    text = " ".join(f"{value:.6e}" for value in np.ravel(calibration))
    return hashlib.sha256(text.encode()).hexdigest()[:16] in _KITTI_CALIBRATIONS


def _looks_like_kittis(load: Callable[[int], Scan], count: int) -> bool:
    """Whether the first scan that can be read is as from KITTI's lidar, and not simulated with its calibration.

    Its reflectances are hundredths, and its beams, which do not start at one point, fill nearly all elevations.
    """
    for k in range(min(count, _SCANS_TO_LOOK_AT)):
        try:
            scan = load(k)
        except DataError:
            continue
        x, y, z = scan.points.T
        across = np.hypot(x, y)
        far = (across > 5) & (across < 60)
        seen = np.histogram(np.degrees(np.arctan2(z[far], across[far])), _ELEVATIONS_DEG)[0] > 0
        hundredths = 100 * (np.zeros(0) if scan.intensity is None else scan.intensity)
        whole = np.abs(hundredths - np.round(hundredths)) < 1e-3
        return bool(seen.mean() > _SHARE_SEEN and whole.all() and len(np.unique(hundredths)) >= _LEAST_REFLECTANCES)
    return False
