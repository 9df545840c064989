"""Run the odometry on one recording with four sources of initial poses, chosen by name.

    python examples/swap_initial_pose.py [FOLDER] [SECONDS]

`lstm` uses the weights shipped with hybridlio. Everything else is the same: scans are matched with a local map, and the
factor graph combines all measurements. The sources differ in the error of a step before scan matching.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import hybridlio as hl
from hybridlio.core import se3


def main(folder: str | None = None, seconds: str = "5") -> None:
    root = Path(folder or tempfile.mkdtemp(prefix="hybridlio-"))
    drive = hl.simulate(root, hl.SimulationConfig(seconds=float(seconds), seed=7, lidar="16-beam"))
    sequence = hl.open_sequence(drive)
    steps = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    for name in ("preintegration", "lstm", "kalman", "constant-velocity"):
        odometry = hl.Odometry(initial_pose=name)
        estimates = [odometry.step(frame) for frame in sequence]
        initial = np.array([estimate.initial.pose for estimate in estimates[1:]])
        error_m = np.linalg.norm(
            se3.log(se3.between(steps, initial))[1:, 3:], axis=1
        )  # the speed is unknown at the first step
        end_error_m = np.linalg.norm(estimates[-1].pose[:3, 3] - sequence.reference.poses[-1, :3, 3])
        print(f"{name}: mean error of the initial poses {error_m.mean():.3f} m, of the last pose {end_error_m:.3f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
