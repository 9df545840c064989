"""The rig of the simulated car: where its sensors are mounted, and how fast they measure.

Rates and positions follow KITTI's car (Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013): lidar
1.73 m above the road, IMU 0.80 m behind, 0.32 m beside and 0.80 m below it, camera 0.27 m ahead of it. Rotations of up
to 0.7° keep the sensors' axes apart, so that an error in the use of a transform shows.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import GRAVITY_M_S2

GRAVITY_WORLD_M_S2: Final = np.array([0.0, 0.0, -GRAVITY_M_S2])
"""Gravity in the world frame (x east, y north, z up)."""

IMU_RATE_HZ: Final = 100  # of KITTI's unsynchronised recordings
SCAN_RATE_HZ: Final = 10  # a turn of KITTI's lidar


def _mount(translation_m: tuple[float, float, float], euler_xyz_deg: tuple[float, float, float]) -> Array:
    return se3.make(Rotation.from_euler("xyz", euler_xyz_deg, degrees=True).as_matrix(), translation_m)


# vehicle frame: on the ground below the middle of the rear axle, x forward, y left, z up
T_VEHICLE_LIDAR: Final = _mount((0.80, 0.0, 1.73), (0.0, 0.0, 0.0))
# Lever arms near those of KITTI's car; the small tilts reveal rotations that are left out or used the wrong way round.
T_LIDAR_IMU: Final = _mount((-0.80, 0.32, -0.80), (0.7, -0.15, 0.05))
T_CAMERA_LIDAR: Final = se3.make(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    @ Rotation.from_euler("xyz", (0.3, -0.5, 0.2), degrees=True).as_matrix(),
    (0.0, -0.08, -0.27),
)

T_IMU_LIDAR: Final = se3.inverse(T_LIDAR_IMU)
T_VEHICLE_IMU: Final = T_VEHICLE_LIDAR @ T_LIDAR_IMU
LIDAR_HEIGHT_M: Final = float(T_VEHICLE_LIDAR[2, 3])
