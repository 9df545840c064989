"""The same recording with its initial poses from four sources, exchanged by one word.

    python examples/swap_initial_pose.py [FOLDER] [SECONDS]

`lstm` takes the weights that come with hybridlio, and everything else stays as it is: the scans are matched to a local
map, and the graph joins all. What differs is how far off a step is before the scans have been looked at.
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
        off = np.linalg.norm(se3.log(se3.between(steps, initial))[1:, 3:], axis=1)  # the first one knows no speed
        end = np.linalg.norm(estimates[-1].pose[:3, 3] - sequence.reference.poses[-1, :3, 3])
        print(f"{name}: initial poses are off by {off.mean():.3f} m a step, the end by {end:.3f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
