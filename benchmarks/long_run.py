"""Whether the cost of a scan, and memory, grow with the run: one simulated drive over and over, as one long recording.

    python benchmarks/long_run.py DATA [--scans 4500] [--backend fixed-lag,incremental] [--light] [-o FILE]

The drive's scans are taken forth and back, so that they follow each other; inertial samples do not fit that and are
left out, initial poses are by constant velocity. --light leaves the scans out instead: noisy steps and the samples of
a drive straight on go through the graph alone. Printed: median milliseconds of the first and the last 500 scans by
stage and, as a machine may be busy, in processor time; and resident memory.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio import se3
from hybridlio.config import Config
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.estimates import RelativePose
from hybridlio.files import write_whole
from hybridlio.odometry import Odometry
from hybridlio.sensors import Calibration, Frame, ImuSamples, Scan

PART = 500
CPU = "whole step, processor time"
_STEP_NS = 100_000_000


class StraightOn:
    """A residual source that looks at nothing: 1 m a scan, give or take 2 cm."""

    name = "straight-on"

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def start(self, frame: Frame) -> None:
        """Nothing to keep."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        """The step with its noise; as of a map, so that the path has poses of its own."""
        sigmas = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]
        step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]) + sigmas * self._rng.standard_normal(6))
        covariance = np.diag(sigmas**2)
        return RelativePose(step, covariance, self.name, drift=0.1 * covariance)


def light_frames(scans: int) -> Iterator[Frame]:
    """Frames without points, each with the samples of a drive straight on at one speed."""
    rng, nothing = np.random.default_rng(1), np.empty((0, 3), np.float32)
    for k in range(scans):
        stamps = np.arange(k * _STEP_NS, (k + 1) * _STEP_NS + 1, _STEP_NS // 10)
        gyro = 0.01 * rng.standard_normal((11, 3))
        accel = np.array([0.0, 0.0, 9.81]) + 0.1 * rng.standard_normal((11, 3))
        yield Frame(k, Scan((k + 1) * _STEP_NS, nothing), ImuSamples(stamps, gyro, accel), calibration=Calibration())


def there_and_back(sequence: Sequence, scans: int) -> Iterator[Frame]:
    """The drive's scans forth and back, as one recording."""
    period = 2 * (len(sequence) - 1)
    for k in range(scans):
        row = k % period
        scan = sequence[min(row, period - row)].scan
        yield Frame(k, replace(scan, stamp_ns=k * _STEP_NS))


def resident_mib() -> float:
    """Memory that the process holds now."""
    gc.collect()
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def run(frames: Iterator[Frame], odometry: Odometry) -> dict[str, Any]:
    """Milliseconds of the first and last ``PART`` scans by stage, and memory every ``PART`` scans."""
    stages: dict[str, list[float]] = {}
    memory: dict[int, float] = {}
    for k, frame in enumerate(frames):
        start = time.process_time()
        estimate = odometry.step(frame)
        stages.setdefault(CPU, []).append(1e3 * (time.process_time() - start))
        for stage, seconds in estimate.seconds.items():
            stages.setdefault(stage, []).append(1e3 * seconds)
        if k and k % PART == 0:
            memory[k] = resident_mib()
    spent = {stage: np.array([0.0] * (k + 1 - len(ms)) + ms) for stage, ms in stages.items()}
    return {
        "first_ms": {stage: float(np.median(ms[:PART])) for stage, ms in spent.items()},
        "last_ms": {stage: float(np.median(ms[-PART:])) for stage, ms in spent.items()},
        "slowest_percent_ms": {stage: float(np.percentile(ms, 99)) for stage, ms in spent.items()},
        "resident_mib": memory,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="a recording; not needed with --light")
    parser.add_argument("--scans", type=int, default=4500)
    parser.add_argument("--backend", default="fixed-lag", metavar="A,B,…")
    parser.add_argument("--light", action="store_true")
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    if options.data is None and not options.light:
        parser.error("give a recording, or --light")
    results = {}
    for backend in options.backend.split(","):
        if options.light:
            frames, odometry = light_frames(options.scans), Odometry(residual=StraightOn(), backend=backend)
        else:
            frames = there_and_back(open_sequence(options.data), options.scans)
            odometry = Odometry(config=Config(initial_pose="constant-velocity", backend=backend))
        results[backend] = found = run(frames, odometry)
        ratio = found["last_ms"][CPU] / found["first_ms"][CPU]
        memory = list(found["resident_mib"].values())
        grown = memory[-1] - memory[0] if memory else float("nan")
        print(f"{backend}: last {PART} scans take {ratio:.2f} times the first {PART}'s, memory grew by {grown:.0f} MiB")
        print(json.dumps(found, indent=2))
    if options.out is not None:
        write_whole(options.out, json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
