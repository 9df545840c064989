"""The simulated car's sensors: where they sit, in the arrangement of KITTI's car, and the physics' constants."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import GRAVITY_M_S2

GRAVITY_WORLD_M_S2: Final = np.array([0.0, 0.0, -GRAVITY_M_S2])
"""Gravity in the world frame (x east, y north, z up)."""

IMU_RATE_HZ: Final = 100
SCAN_RATE_HZ: Final = 10


def _mount(translation_m: tuple[float, float, float], euler_xyz_deg: tuple[float, float, float]) -> Array:
    return se3.make(Rotation.from_euler("xyz", euler_xyz_deg, degrees=True).as_matrix(), translation_m)


# the vehicle frame: on the ground below the middle of the rear axle, x forward, y left, z up
T_VEHICLE_LIDAR: Final = _mount((0.80, 0.0, 1.73), (0.0, 0.0, 0.0))
T_LIDAR_IMU: Final = _mount((-0.80, 0.32, -0.80), (0.7, -0.15, 0.05))
T_CAMERA_LIDAR: Final = se3.make(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    @ Rotation.from_euler("xyz", (0.3, -0.5, 0.2), degrees=True).as_matrix(),
    (0.0, -0.08, -0.27),
)

T_IMU_LIDAR: Final = se3.inverse(T_LIDAR_IMU)
T_VEHICLE_IMU: Final = T_VEHICLE_LIDAR @ T_LIDAR_IMU
LIDAR_HEIGHT_M: Final = float(T_VEHICLE_LIDAR[2, 3])
