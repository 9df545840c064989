"""Whether the cost of a scan, and memory, grow with the run: one lap over and over, as one long recording.

    python benchmarks/long_run.py FOLDER [--scans 4500] [--backend fixed-lag,incremental] [-o FILE]
    python benchmarks/long_run.py --light

The lap is 314 m around in a simulated town, of HDL-64E scans with a 100 Hz IMU; it is simulated below FOLDER unless it
is there. Its end fits its beginning, so that laps follow each other as one drive. The local map forgets what is
out of sight long before it comes again; what is seen across the circle fills up for ten laps. --light leaves the scans
out: noisy steps and the samples of a drive straight on go through the graph alone.

Printed: how much processor time the last 500 scans take beside the first 500 of a run that has just begun, in a process
of its own, at the same place of the lap. The two take turns scan by scan, so that what else the machine does, or how
fast it is by then, changes both. The start's twenty scans do not count; means, as half of the scans bring a keyframe
and a median lies between two kinds. Then median milliseconds of the first and the last 500 by stage, and resident
memory, with the estimates kept as `hybridlio odometry` keeps them.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.commands.terminal import progress
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import write_atomically
from hybridlio.core.packed_arrays import PackedList
from hybridlio.core.sensors import Calibration, Frame, ImuSamples, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.simulate import simulate

PART = 500
WARM_UP = 20
LAP = 300  # scans
RADIUS_M = 50.0  # 10.5 m/s
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


def light_frames(first: int, scans: int) -> Iterator[Frame]:
    """Frames from ``first`` on without points, each with the samples of a drive straight on at one speed."""
    rng, nothing = np.random.default_rng(1), np.empty((0, 3), np.float32)
    for k in range(first, scans):
        stamps = np.arange(k * _STEP_NS, (k + 1) * _STEP_NS + 1, _STEP_NS // 10)
        gyro = 0.01 * rng.standard_normal((11, 3))
        accel = np.array([0.0, 0.0, 9.81]) + 0.1 * rng.standard_normal((11, 3))
        yield Frame(k, Scan((k + 1) * _STEP_NS, nothing), ImuSamples(stamps, gyro, accel), calibration=Calibration())


def the_lap(folder: Path) -> Sequence:
    """A lap whose last scan is where its first is, simulated unless it is there."""
    turn = np.linspace(0, 2 * np.pi, LAP + 1)
    yaw = np.column_stack([np.zeros((LAP + 1, 2)), turn])
    place = RADIUS_M * np.column_stack([np.sin(turn), 1 - np.cos(turn), np.zeros(LAP + 1)])
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "lap.txt", se3.make(se3.so3_exp(yaw), place)[:, :3].reshape(-1, 12))
    config = SimulationConfig(seed=8101, poses=folder / "lap.txt", poses_frame="lidar")
    with progress("the lap") as tick:
        simulate(folder, config, tick)
    return open_sequence(folder)


def laps(sequence: Sequence, first: int, scans: int) -> Iterator[Frame]:
    """The lap's frames from ``first`` on again and again: after its last, which is where the first is, the second."""
    first_ns = int(sequence.stamps_ns[0])
    for k in range(first, scans):
        frame = sequence[(k - 1) % LAP + 1 if k else 0]
        late_ns = first_ns + k * _STEP_NS - frame.scan.stamp_ns
        imu = replace(frame.imu, stamps_ns=frame.imu.stamps_ns + late_ns)
        yield replace(frame, index=k, scan=replace(frame.scan, stamp_ns=frame.scan.stamp_ns + late_ns), imu=imu)


def laps_below(folder: Path, first: int, scans: int) -> Iterator[Frame]:
    """The same of the lap below a folder, which another process can open too."""
    return laps(the_lap(folder), first, scans)


def resident_mib() -> float:
    """Memory that the process holds now."""
    gc.collect()
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def made(backend: str, light: bool) -> Odometry:
    """A fresh one."""
    return Odometry(residual=StraightOn(), backend=backend) if light else Odometry(backend=backend)


class Fresh:
    """A run in a process of its own that goes on by one scan when it is told to.

    Args:
        frames: from where it begins.
        make: its odometry.
    """

    def __init__(self, frames: Callable[[], Iterator[Frame]], make: Callable[[], Odometry]) -> None:
        context = multiprocessing.get_context("spawn")
        self._talk, theirs = context.Pipe()
        context.Process(target=_serve, args=(theirs, frames, make), daemon=True).start()

    def step_cpu_ms(self) -> float:
        """Processor time of its next scan."""
        self._talk.send(None)
        return float(self._talk.recv())


def _serve(talk: Connection, frames: Callable[[], Iterator[Frame]], make: Callable[[], Odometry]) -> None:
    odometry = make()
    for frame in frames():
        talk.recv()
        talk.send(_step(odometry, frame)[1])


def _step(odometry: Odometry, frame: Frame) -> tuple[Estimate, float]:
    """With its processor time in milliseconds."""
    start = time.process_time()
    estimate = odometry.step(frame)
    return estimate, 1e3 * (time.process_time() - start)


def run(frames: Callable[[int, int], Iterator[Frame]], make: Callable[[], Odometry], scans: int) -> dict[str, Any]:
    """Milliseconds of the first and last ``PART`` scans by stage, and memory every ``PART`` scans."""
    stages: dict[str, list[float]] = {}
    memory: dict[int, float] = {}
    kept: PackedList[Estimate] = PackedList()
    odometry, begin = make(), max(scans - PART - WARM_UP, 0)
    fresh, fresh_ms = Fresh(partial(frames, begin, scans), make), []
    for k, frame in enumerate(frames(0, scans)):
        estimate, cpu_ms = _step(odometry, frame)
        stages.setdefault(CPU, []).append(cpu_ms)
        kept.append(estimate)
        for stage, seconds in estimate.seconds.items():
            stages.setdefault(stage, []).append(1e3 * seconds)
        if k >= begin:
            fresh_ms.append(fresh.step_cpu_ms())
        if (k + 1) % PART == 0:
            memory[k + 1] = resident_mib()
    spent = {stage: np.array([0.0] * (scans - len(ms)) + ms) for stage, ms in stages.items()}
    return {
        "fresh_mean_cpu_ms": float(np.mean(fresh_ms[WARM_UP:])),
        "last_mean_cpu_ms": float(spent[CPU][begin + WARM_UP :].mean()),
        "first_ms": {stage: float(np.median(ms[:PART])) for stage, ms in spent.items()},
        "last_ms": {stage: float(np.median(ms[-PART:])) for stage, ms in spent.items()},
        "slowest_percent_ms": {stage: float(np.percentile(ms, 99)) for stage, ms in spent.items()},
        "resident_mib": memory,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="for the lap; not needed with --light")
    parser.add_argument("--scans", type=int, default=4500)
    parser.add_argument("--backend", default="fixed-lag", metavar="A,B,…")
    parser.add_argument("--light", action="store_true")
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    if options.folder is None and not options.light:
        parser.error("give a folder for the lap, or --light")
    results = {}
    for backend in options.backend.split(","):
        frames = light_frames if options.light else partial(laps_below, options.folder)
        results[backend] = found = run(frames, partial(made, backend, options.light), options.scans)
        ratio = found["last_mean_cpu_ms"] / found["fresh_mean_cpu_ms"]
        memory = list(found["resident_mib"].values())
        grown = memory[-1] - memory[0] if memory else float("nan")
        grew = f"memory grew by {grown:.0f} MiB"
        print(f"{backend}: the last {PART} scans take {ratio:.2f} times the processor time of a run's first, {grew}")
        print(json.dumps(found, indent=2))
    if options.out is not None:
        write_atomically(options.out, json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
