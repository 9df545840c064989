"""Run the odometry frame by frame on a short simulated drive, and print the error of the last pose.

python examples/odometry_from_python.py [FOLDER] [SECONDS]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import hybridlio as hl


def main(folder: str | None = None, seconds: str = "5") -> None:
    root = Path(folder or tempfile.mkdtemp(prefix="hybridlio-"))
    drive = hl.simulate(root, hl.SimulationConfig(seconds=float(seconds), seed=7, lidar="16-beam"))
    sequence = hl.open_sequence(drive)
    odometry = hl.Odometry(initial_pose="preintegration", residual="scan-matching")
    for frame in sequence:
        estimate = odometry.step(frame)
    sigma_m = np.sqrt(estimate.covariance.diagonal()[3:])
    error_m = estimate.pose[:3, 3] - sequence.reference.poses[-1, :3, 3]
    print(f"{drive}: {len(sequence)} scans, {sequence.reference.length_m:.1f} m")
    print(f"error of the last position: {np.linalg.norm(error_m):.3f} m, standard deviation {sigma_m.max():.3f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
