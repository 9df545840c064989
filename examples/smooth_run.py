"""Smooth a finished run: run the odometry on a simulated drive, save its record, and optimise all poses together.

python examples/smooth_run.py [FOLDER] [SECONDS]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import hybridlio as hl
from hybridlio.record.record import Record
from hybridlio.runs.run import run_odometry


def main(folder: str | None = None, seconds: str = "6", *_: str) -> None:
    root = Path(folder or tempfile.mkdtemp(prefix="hybridlio-"))
    drive = hl.simulate(root, hl.SimulationConfig(seconds=float(seconds), seed=7, lidar="16-beam"))
    sequence = hl.open_sequence(drive)
    run = run_odometry(sequence, hl.Odometry())
    run.record.save(root / "odometry.npz")  # as `hybridlio odometry` does in a run folder

    smoothed = hl.smooth(Record.load(root / "odometry.npz"))
    for name, trajectory in (("odometry", run.trajectory), ("smoothed", smoothed.trajectory)):
        found = hl.evaluate(trajectory, sequence.reference)
        print(f"{name}: RMS error per step {1e3 * found.rpe_m:.1f} mm, {found.rpe_deg:.4f} degrees")
    print(f"error {smoothed.error_before:.4g} -> {smoothed.error_after:.4g} in {smoothed.iterations} iterations")


if __name__ == "__main__":
    main(*sys.argv[1:])
