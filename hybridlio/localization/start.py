"""A start that the user gives: position and heading in the map, of which scan and map supply the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, EstimationError
from hybridlio.core.sensors import Scan
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.prior_map import PriorMap
from hybridlio.localization.viewpoints import GROUND_RADIUS_M, ground_m
from hybridlio.smoothing.places import levelling_rotations

Start = Sequence[float]  # x, y (metres) and yaw (radians) in the map frame

# What a click on a map gives: some metres and degrees. Height and inclination come from ground and gravity.
_POSITION_SIGMA_M, _YAW_SIGMA_RAD = 1.5, np.deg2rad(5.0)
_HEIGHT_SIGMA_M, _TILT_SIGMA_RAD = 0.5, np.deg2rad(2.0)


def check_start(start: Start) -> tuple[float, float, float]:
    """Return the start as three numbers.

    Raises:
        ConfigError: it is something else.
    """
    try:
        x, y, yaw = (float(value) for value in start)
    except (TypeError, ValueError):
        raise ConfigError(f"a start is x, y (metres) and yaw (radians) in the map, got {start!r:.60}") from None
    if not np.isfinite([x, y, yaw]).all():
        raise ConfigError(f"a start must be finite, got {start!r:.60}")
    return x, y, yaw


def start_pose(prior: PriorMap, scan: Scan, up: Array, start: Start) -> UncertainPose:
    """Return the pose of the first scan in the map.

    Args:
        prior: the map.
        scan: the scan, motion compensated.
        up: ``(3,)`` in the scan's frame.
        start: position and heading.

    Raises:
        EstimationError: the map has no points at the start.
    """
    x, y, yaw = check_start(start)
    T_level_lidar, T_level_map = (levelling_rotations(np.eye(4)[None], one)[0] for one in (up, prior.up))
    turned = se3.make(se3.so3_exp([0.0, 0.0, yaw]), np.zeros(3)) @ T_level_lidar
    pose = se3.inverse(T_level_map) @ turned
    own = ground_m(se3.transform(T_level_lidar, scan.points.astype(np.float64)), np.zeros(2))
    at = np.array([x, y, 0.0])
    there = ground_m(prior.surface.points, at[:2])
    if np.isnan(there) or np.isnan(own):
        where = "map" if np.isnan(there) else "scan"
        raise EstimationError(f"the {where} has no points within {GROUND_RADIUS_M:g} m of the start ({x:g}, {y:g})")
    pose[:3, 3] = [x, y, there - own]
    sigmas = np.array([_TILT_SIGMA_RAD] * 2 + [_YAW_SIGMA_RAD] + [_POSITION_SIGMA_M] * 2 + [_HEIGHT_SIGMA_M])
    return UncertainPose(pose, se3.rotate_covariance(np.diag(sigmas**2), se3.inverse(T_level_lidar)))
