"""Measure how the time of a scan and memory grow over a long run: one lap, repeated, as a single recording.

    python benchmarks/long_run.py FOLDER [--scans 4500] [--backend fixed-lag,incremental] [-o FILE]
    python benchmarks/long_run.py --light

The lap is a circle of 314 m in a simulated town, with HDL-64E scans and a 100 Hz IMU. It is simulated in FOLDER unless
FOLDER holds it, and ends where it starts, so that laps join without a gap. The local map drops what is out of sight
long before the next lap, but what is visible across the circle accumulates for ten laps. --light leaves the scans out:
noisy steps and the IMU samples of a straight drive go through the graph alone.

Prints the ratio of two mean processor times: of the last 500 scans, and of the first 500 scans of a fresh run at the
same places of the lap, in another process. Both take turns scan by scan, so other load and the clock rate of the
machine affect them alike. The first 20 scans of the fresh run do not count. Means, because every other scan brings a
keyframe, and a median would fall between the two kinds. Then come medians of the first and last 500 scans by stage, and
resident memory; estimates are kept as `hybridlio odometry` keeps them.
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
from common import resident_mib

from hybridlio.commands.terminal import progress
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import Calibration, Frame, ImuSamples, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.packed_arrays import PackedList
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.simulate import simulate

PART = 500  # scans that are averaged
WARM_UP = 20  # scans of the fresh run that do not count
LAP = 300  # scans
RADIUS_M = 50.0  # gives 10.5 m/s
CPU = "whole step, processor time"
_STEP_NS = 100_000_000


class StraightDrive:
    """A residual source that ignores the scans: 1 m forward a scan, with noise of 2 cm."""

    name = "straight-drive"

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def start(self, frame: Frame) -> None:
        """Do nothing."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        """Return a noisy step. It has a drift, as registration to a map has, so that the graph adds path poses."""
        sigmas = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]
        step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]) + sigmas * self._rng.standard_normal(6))
        covariance = np.diag(sigmas**2)
        return RelativePose(step, covariance, self.name, drift=0.1 * covariance)


def light_frames(first: int, scans: int) -> Iterator[Frame]:
    """Yield frames from ``first`` on without points, with the IMU samples of a straight drive at constant speed."""
    rng, nothing = np.random.default_rng(1), np.empty((0, 3), np.float32)
    for k in range(first, scans):
        stamps = np.arange(k * _STEP_NS, (k + 1) * _STEP_NS + 1, _STEP_NS // 10)
        gyro = 0.01 * rng.standard_normal((11, 3))
        accel = np.array([0.0, 0.0, 9.81]) + 0.1 * rng.standard_normal((11, 3))
        yield Frame(k, Scan((k + 1) * _STEP_NS, nothing), ImuSamples(stamps, gyro, accel), calibration=Calibration())


def simulated_lap(folder: Path, lidar: str = "hdl-64e") -> Sequence:
    """Open the lap in a folder; simulate it first unless the folder holds it. It ends at its first pose."""
    turn = np.linspace(0, 2 * np.pi, LAP + 1)
    yaw = np.column_stack([np.zeros((LAP + 1, 2)), turn])
    place = RADIUS_M * np.column_stack([np.sin(turn), 1 - np.cos(turn), np.zeros(LAP + 1)])
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "lap.txt", se3.make(se3.so3_exp(yaw), place)[:, :3].reshape(-1, 12))
    config = SimulationConfig(seed=8101, lidar=lidar, poses=folder / "lap.txt", poses_frame="lidar")
    with progress("simulating the lap") as tick:
        simulate(folder, config, tick)
    return open_sequence(folder)


def laps(sequence: Sequence, first: int, scans: int) -> Iterator[Frame]:
    """Yield the frames ``first`` to ``scans`` of repeated laps. The second frame of a lap follows the last one."""
    first_ns = int(sequence.stamps_ns[0])
    for k in range(first, scans):
        frame = sequence[(k - 1) % LAP + 1 if k else 0]
        shift_ns = first_ns + k * _STEP_NS - frame.scan.stamp_ns
        imu = replace(frame.imu, stamps_ns=frame.imu.stamps_ns + shift_ns)
        yield replace(frame, index=k, scan=replace(frame.scan, stamp_ns=frame.scan.stamp_ns + shift_ns), imu=imu)


def laps_in(folder: Path, first: int, scans: int) -> Iterator[Frame]:
    """Yield the frames of repeated laps in a folder. A partial of this function can be sent to another process."""
    return laps(simulated_lap(folder), first, scans)


def make_odometry(backend: str, light: bool) -> Odometry:
    """Make the odometry of a run."""
    return Odometry(residual=StraightDrive(), backend=backend) if light else Odometry(backend=backend)


class FreshRun:
    """A run in another process that advances by one scan at each call.

    Args:
        frames: yields its frames.
        make: makes its odometry.
    """

    def __init__(self, frames: Callable[[], Iterator[Frame]], make: Callable[[], Odometry]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        context.Process(target=_serve, args=(theirs, frames, make), daemon=True).start()

    def step_cpu_ms(self) -> float:
        """Process the next scan and return its processor time in milliseconds."""
        self._connection.send(None)
        return float(self._connection.recv())


def _serve(connection: Connection, frames: Callable[[], Iterator[Frame]], make: Callable[[], Odometry]) -> None:
    odometry = make()
    for frame in frames():
        connection.recv()
        connection.send(_step(odometry, frame)[1])


def _step(odometry: Odometry, frame: Frame) -> tuple[Estimate, float]:
    """Return the estimate and its processor time in milliseconds."""
    start = time.process_time()
    estimate = odometry.step(frame)
    return estimate, 1e3 * (time.process_time() - start)


def run(frames: Callable[[int, int], Iterator[Frame]], make: Callable[[], Odometry], scans: int) -> dict[str, Any]:
    """Return milliseconds of the first and last ``PART`` scans by stage, and memory every ``PART`` scans."""
    stages: dict[str, list[float]] = {}
    memory: dict[int, float] = {}
    kept: PackedList[Estimate] = PackedList()
    odometry, begin = make(), max(scans - PART - WARM_UP, 0)
    fresh, fresh_ms = FreshRun(partial(frames, begin, scans), make), []
    for k, frame in enumerate(frames(0, scans)):
        estimate, cpu_ms = _step(odometry, frame)
        stages.setdefault(CPU, []).append(cpu_ms)
        kept.append(estimate)
        for stage, seconds in estimate.seconds.items():
            stages.setdefault(stage, []).append(1e3 * seconds)
        if k >= begin:
            fresh_ms.append(fresh.step_cpu_ms())
        if (k + 1) % PART == 0:
            gc.collect()
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
    """Run the benchmark for each backend and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="for the lap; not needed with --light")
    parser.add_argument("--scans", type=int, default=4500, help="length of the run (default: %(default)s)")
    parser.add_argument("--backend", default="fixed-lag", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--light", action="store_true", help="IMU and graph alone, without scans")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="for all figures as JSON")
    options = parser.parse_args()
    if options.folder is None and not options.light:
        parser.error("a folder for the lap is missing; give one, or --light")
    results = {}
    for backend in options.backend.split(","):
        frames = light_frames if options.light else partial(laps_in, options.folder)
        results[backend] = found = run(frames, partial(make_odometry, backend, options.light), options.scans)
        ratio = found["last_mean_cpu_ms"] / found["fresh_mean_cpu_ms"]
        memory = list(found["resident_mib"].values())
        growth = memory[-1] - memory[0] if memory else float("nan")
        print(f"{backend}: processor time of the last {PART} scans / first {PART} of a fresh run: {ratio:.2f}")
        print(f"{backend}: growth of memory: {growth:.0f} MiB")
        print(json.dumps(found, indent=2))
    if options.out is not None:
        write_atomically(options.out, json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
