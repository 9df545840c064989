"""Georeferencing: a trajectory aligned with GPS fixes as a whole, and written for other programs."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.files import write_atomically
from hybridlio.core.geodesy import GeodeticPoint, geodetic_from_enu
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory, write_tum
from hybridlio.smoothing.gps_alignment import LEVEL_SIGMA_RAD, MAX_SHIFT_S, FixAlignment, align_fixes

if TYPE_CHECKING:
    from hybridlio.record.record import Record


POSES_ENU, TABLE, MAP = "poses_enu_tum.txt", "georeferenced.csv", "georeferenced.geojson"
FILES = (POSES_ENU, TABLE, MAP)
# Of the mean specific force against the vertical: accelerations average out over a run, but an accelerometer bias of
# 0.1 m/s² remains.
_GRAVITY_SIGMA_RAD = 0.01


@dataclass(frozen=True, eq=False)
class Georeferenced:
    """A trajectory in the frame of the fixes.

    Attributes:
        trajectory: lidar poses, east-north-up.
        origin: of that frame on Earth; None if the fixes do not tell.
        alignment: with the fixes.
    """

    trajectory: Trajectory
    origin: GeodeticPoint | None
    alignment: FixAlignment

    @property
    def geodetic(self) -> Array:
        """``(N, 3)`` latitude and longitude in degrees, height in metres.

        Raises:
            DataError: the origin is unknown.
        """
        if self.origin is None:
            raise DataError(
                "the fixes are in a local frame whose origin on Earth is not known; give the origin as latitude, "
                "longitude (degrees) and height (metres)"
            )
        return geodetic_from_enu(self.trajectory.poses[:, :3, 3], self.origin)


def georeference(
    record: Record,
    trajectory: Trajectory | None = None,
    *,
    antenna_m: Array | None = None,
    max_shift_s: float = MAX_SHIFT_S,
    origin: GeodeticPoint | None = None,
) -> Georeferenced:
    """Align a run with its GPS fixes by one rigid motion and one shift of the clocks, without changing its shape.

    Args:
        record: of the run.
        trajectory: lidar poses to align, such as smoothed ones; by default the odometry's.
        antenna_m: ``(3,)`` the antenna in the IMU's frame; by default the calibration's, or else the IMU's origin.
        max_shift_s: largest difference of the clocks; 0 takes the stamps as they are.
        origin: of the fixes' frame on Earth, if the fixes do not tell.

    Raises:
        EstimationError: fewer than three fixes lie in the run's time.
    """
    trajectory = trajectory or record.online
    T_imu_lidar = record.calibration.T_imu_lidar
    antenna = record.calibration.antenna_imu_m if antenna_m is None else np.asarray(antenna_m, dtype=np.float64)
    lever = se3.transform(se3.inverse(T_imu_lidar), np.zeros((1, 3)) if antenna is None else antenna[None])[0]
    up, sigma = np.array([0.0, 0.0, 1.0]), LEVEL_SIGMA_RAD
    if record.start.has_imu:
        up, sigma = _up_from_forces(record, trajectory), _GRAVITY_SIGMA_RAD
    path = PosePath(trajectory.stamps_ns, trajectory.poses)
    alignment = align_fixes(path, record.gps, lever, up, sigma, max_shift_s)
    placed = Trajectory(trajectory.stamps_ns, alignment.T_enu_world @ trajectory.poses, trajectory.covariances)
    return Georeferenced(placed, record.origin or origin, alignment)


def _up_from_forces(record: Record, trajectory: Trajectory) -> Array:
    """Up in the trajectory's frame, of any length: the mean specific force less the mean acceleration.

    The mean acceleration is the change of the velocity from the trajectory's first to its last pose, over the time.
    """
    path = PosePath(trajectory.stamps_ns, trajectory.poses)
    inside = path.covers(record.imu.stamps_ns)
    stamps, force = record.imu.stamps_ns[inside], record.imu.accel_m_s2[inside]
    R = path.at(stamps)[:, :3, :3] @ record.calibration.T_imu_lidar[:3, :3].T
    mean = (R @ force[..., None])[..., 0].mean(axis=0)
    _, ends = path.points(trajectory.stamps_ns[[0, -1]], np.zeros(3))
    span_s = float(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0]) / NS_PER_S
    return np.asarray(mean - (ends[1] - ends[0]) / span_s)


def write_georeferenced(folder: Path, placed: Georeferenced) -> list[Path]:
    """Write the poses as a TUM file in the frame of the fixes and, if its origin is known, as CSV and GeoJSON.

    The CSV has one row per scan: stamp, latitude, longitude, height, east, north, up, heading (degrees clockwise from
    north). The GeoJSON is one line string with heights.

    Returns:
        The paths of the files.

    Raises:
        DataError: a file cannot be written.
    """
    write_tum(folder / POSES_ENU, placed.trajectory)
    if placed.origin is None:
        return [folder / POSES_ENU]
    geodetic = placed.geodetic
    write_atomically(folder / TABLE, _table(placed.trajectory, geodetic))
    write_atomically(folder / MAP, _geojson(placed, geodetic))
    return [folder / name for name in FILES]


def _table(trajectory: Trajectory, geodetic: Array) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["stamp_ns", "latitude", "longitude", "height", "east", "north", "up", "heading_deg"])
    forward = trajectory.poses[:, :3, 0]
    headings = np.degrees(np.arctan2(forward[:, 0], forward[:, 1])) % 360
    for stamp, place, pose, heading in zip(trajectory.stamps_ns, geodetic, trajectory.poses, headings, strict=True):
        degrees, metres = [f"{v:.10f}" for v in place[:2]], [f"{v:.4f}" for v in (place[2], *pose[:3, 3])]
        writer.writerow([int(stamp), *degrees, *metres, f"{heading:.4f}"])
    return text.getvalue()


def _geojson(placed: Georeferenced, geodetic: Array) -> str:
    line = [[round(longitude, 10), round(latitude, 10), round(height, 3)] for latitude, longitude, height in geodetic]
    properties = {"start_ns": int(placed.trajectory.stamps_ns[0]), "end_ns": int(placed.trajectory.stamps_ns[-1])}
    feature = {"type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": line}}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n"
