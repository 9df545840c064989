"""A trajectory on the map: placed on GPS fixes as a whole, and written for other programs."""

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
from hybridlio.core.trajectory import Trajectory
from hybridlio.core.trajectory_files import write_tum
from hybridlio.smoothing.gps_alignment import LEVEL_SIGMA_RAD, MAX_SHIFT_S, FixAlignment, align_fixes

if TYPE_CHECKING:
    from hybridlio.record.record import Record


POSES_ENU, TABLE, MAP = "poses_enu_tum.txt", "georeferenced.csv", "georeferenced.geojson"
_GRAVITY_SIGMA_RAD = 0.01


@dataclass(frozen=True, eq=False)
class Georeferenced:
    """A trajectory in the fixes' frame.

    Attributes:
        trajectory: lidar poses, east-north-up.
        origin: where on Earth that frame has its origin; None where the fixes do not say.
        alignment: how it was placed.
    """

    trajectory: Trajectory
    origin: GeodeticPoint | None
    alignment: FixAlignment

    @property
    def geodetic(self) -> Array:
        """``(N, 3)`` latitude and longitude in degrees, height in metres.

        Raises:
            DataError: the origin is not known.
        """
        if self.origin is None:
            raise DataError(
                "the fixes are in a local frame whose origin on Earth is not known; give it as latitude, longitude "
                "(degrees) and height (metres)"
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
    """Place a run on its GPS fixes by one rigid motion and one shift of the clocks; its shape is not touched.

    Args:
        record: of the run.
        trajectory: lidar poses to place, such as smoothed ones; by default the odometry's.
        antenna_m: ``(3,)`` the antenna in the IMU's frame; by default the calibration's, or the IMU's own place.
        max_shift_s: the clocks are no farther apart; 0 takes the stamps as they are.
        origin: where on Earth the fixes' frame has its origin, where they do not say.

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
    """Up in the trajectory's frame: where the specific force points on average, less what speeding up adds."""
    path = PosePath(trajectory.stamps_ns, trajectory.poses)
    inside = path.covers(record.imu.stamps_ns)
    stamps, force = record.imu.stamps_ns[inside], record.imu.accel_m_s2[inside]
    R = path.at(stamps)[:, :3, :3] @ record.calibration.T_imu_lidar[:3, :3].T
    mean = (R @ force[..., None])[..., 0].mean(axis=0)
    _, ends = path.points(trajectory.stamps_ns[[0, -1]], np.zeros(3))
    span_s = float(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0]) / NS_PER_S
    return np.asarray(mean - (ends[1] - ends[0]) / span_s)


def write_georeferenced(folder: Path, placed: Georeferenced) -> list[Path]:
    """Write the poses as TUM in the fixes' frame and, where on Earth that is known, as CSV and GeoJSON.

    The CSV has a row a scan: stamp, latitude, longitude, height, east, north, up, heading (degrees from north,
    clockwise). The GeoJSON is one line with heights.

    Raises:
        DataError: a file cannot be written.
    """
    write_tum(folder / POSES_ENU, placed.trajectory)
    if placed.origin is None:
        return [folder / POSES_ENU]
    geodetic = placed.geodetic
    write_atomically(folder / TABLE, _table(placed.trajectory, geodetic))
    write_atomically(folder / MAP, _geojson(placed, geodetic))
    return [folder / name for name in (POSES_ENU, TABLE, MAP)]


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
