"""What a finished run shows of the IMU's mounting: its turns in the lidar's frame against those of the scans."""

from __future__ import annotations

import numpy as np

from hybridlio.calibration.clock_offset import find_clock_offset
from hybridlio.calibration.compensation import LARGEST_OFFSET_S
from hybridlio.calibration.turns import Turns
from hybridlio.runs.run import Run

# A rotation that is named: hand-measured mountings are within 2°. Right mountings of 18 simulated drives were found to
# within 0.7° and 3 standard deviations of the stated one, 5° and 10° in eight seconds by 10 and 16 deviations.
_NAMED_DEG, _NAMED_SIGMAS = 2.0, 5.0
_LEAST_SCANS = 50  # five seconds at 10 Hz


def mounting_doubts(run: Run) -> list[str]:
    """Return a line where the run's scans turn about other axes than ``T_imu_lidar`` turns those of the gyroscope to.

    Such a mounting can pass unnoticed while driving, as scans alone give the path.
    """
    sequence, trajectory = run.sequence, run.trajectory
    if len(sequence.imu) < 2 or len(trajectory) < _LEAST_SCANS:
        return []
    R_imu_lidar = sequence.calibration.T_imu_lidar[:3, :3]
    found = find_clock_offset(Turns.of(trajectory), sequence.imu, R_imu_lidar, LARGEST_OFFSET_S)
    if found is None:
        return []
    angle_deg, sigmas = np.degrees(found.rotation_rad), np.abs(found.rotation_rad) / found.rotation_sigma_rad
    size_deg = float(np.linalg.norm(angle_deg))
    if size_deg < _NAMED_DEG or sigmas.max() < _NAMED_SIGMAS:
        return []
    axes = ", ".join(f"{angle:+.1f}" for angle in angle_deg)
    return [
        f"the scans turn as if T_imu_lidar were {size_deg:.1f}° off ({axes} about the IMU's x, y, z): correct the "
        "calibration and run again; the path may be off by more than its covariances"
    ]
