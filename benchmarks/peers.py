"""hybridlio beside KISS-ICP and RKO-LIO: the same scans, one process, the same number of threads.

    pip install 'hybridlio[peers]'
    python benchmarks/peers.py DATA [--sequence 0005] [--frames 0:100] [--repeats 3] [-o DIR]

Each system gets scans that are already read, as it wants them; timed is the call that takes a scan (and, where it
takes them, the inertial samples). Repeats are interleaved, so that a busy machine disturbs all alike. With -o the
table goes to peers.md and every figure to peers.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.config import Config
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.errors import HybridLioError
from hybridlio.files import write_whole
from hybridlio.metrics import Evaluation, evaluate
from hybridlio.odometry import Odometry
from hybridlio.sensors import Frame
from hybridlio.trajectory import Trajectory

Array = NDArray[np.float64]
Step = Callable[[Frame], Array]


@dataclass
class Ran:
    """A system's answer.

    Attributes:
        name: the system's.
        poses: ``(N, 4, 4)`` lidar poses.
        stamps_ns: ``(N,)`` when they hold.
        ms: milliseconds for each scan of each repeat.
    """

    name: str
    poses: list[Array] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)


def ours(initial_pose: str, residual: str, threads: int) -> Callable[[Sequence], Step]:
    settings = Config(initial_pose=initial_pose, residual=residual).model_dump()
    settings["scan_matching"]["local_map"]["threads"] = threads

    def make(_: Sequence) -> Step:
        odometry = Odometry(config=Config.model_validate(settings))
        return lambda frame: odometry.step(frame).pose

    return make


def kiss_icp(threads: int) -> Callable[[Sequence], Step]:
    """Its defaults for a range of 100 m; it compensates motion only where points carry times, to the sweep's end."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    def make(sequence: Sequence) -> Step:
        config = KISSConfig()
        config.data.deskew = sequence[0].scan.time_offsets_ns is not None
        config.mapping.voxel_size = 1.0
        config.registration.max_num_threads = threads
        system = KissICP(config)

        def step(frame: Frame) -> Array:
            offsets = frame.scan.time_offsets_ns
            times = np.empty(0) if offsets is None else (offsets - offsets.min()) / max(np.ptp(offsets), 1)
            system.register_frame(frame.scan.points.astype(np.float64), times)
            return np.array(system.last_pose)

        return step

    return make


def rko_lio(threads: int) -> Callable[[Sequence], Step]:
    """Its defaults; its poses are the IMU's. It wants times that are not all equal, and extrinsics without rounding."""
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    def make(sequence: Sequence) -> Step:
        system = LIO(LIOConfig(deskew=sequence[0].scan.time_offsets_ns is not None, max_num_threads=threads))
        T_imu_lidar = se3.orthonormalise(sequence.calibration.T_imu_lidar)
        fed_ns = -(2**62)

        def step(frame: Frame) -> Array:
            nonlocal fed_ns
            imu, scan = frame.imu, frame.scan
            for stamp, accel, gyro in zip(imu.stamps_ns.tolist(), imu.accel_m_s2, imu.gyro_rad_s, strict=True):
                if stamp > fed_ns:  # frames share the sample on their border
                    system.add_imu_measurement(accel, gyro, stamp)
                    fed_ns = stamp
            times = (
                np.full(len(scan), scan.stamp_ns)
                if scan.time_offsets_ns is None
                else scan.stamp_ns + scan.time_offsets_ns
            )
            if scan.time_offsets_ns is None:
                times[0] -= 1000
            system.register_scan(scan.points.astype(np.float64), times, T_imu_lidar)
            return np.asarray(se3.inverse(T_imu_lidar) @ system.pose() @ T_imu_lidar)

        return step

    return make


def systems(sequence: Sequence, options: argparse.Namespace) -> dict[str, Callable[[Sequence], Step]]:
    """What can run on this recording, ours first."""
    pairs = product(options.initial_pose.split(","), options.residual.split(","))
    out = {f"{a} + {b}": ours(a, b, options.threads) for a, b in pairs}
    peers = {"kiss-icp": kiss_icp} | ({"rko_lio": rko_lio} if len(sequence.imu) else {})
    for name, make in peers.items():
        try:
            out[name] = make(options.threads)
        except ImportError:
            print(f"{name} is not installed: pip install 'hybridlio[peers]'")
    return out


def run(name: str, make: Callable[[Sequence], Step], sequence: Sequence, ran: Ran) -> None:
    """One pass over the sequence, its poses in place of an earlier pass's, its times beside them."""
    step, at_end = make(sequence), name in ("kiss-icp", "rko_lio")
    ran.poses, ran.stamps_ns = [], []
    for k in range(len(sequence)):
        frame = sequence[k]
        start = time.perf_counter()
        pose = step(frame)
        ran.ms.append(1e3 * (time.perf_counter() - start))
        ran.poses.append(pose)
        offsets = frame.scan.time_offsets_ns
        ran.stamps_ns.append(frame.scan.stamp_ns + (int(offsets.max()) if at_end and offsets is not None else 0))


def figures(ran: Ran, sequence: Sequence, ours_ms: float) -> dict[str, Any]:
    """Everything that is said of a system, as plain values."""
    poses = np.array(ran.poses)
    trajectory = Trajectory(np.array(ran.stamps_ns), se3.between(poses[0], poses))
    judged = _judged(trajectory, sequence)
    out: dict[str, Any] = {"system": ran.name}
    if judged is not None:
        short = judged.t_rel_percent is None
        out["t_rel [%]"] = judged.chosen_t_rel_percent if short else judged.t_rel_percent
        out["r_rel [°/100 m]"] = judged.chosen_r_rel_deg_per_100m if short else judged.r_rel_deg_per_100m
        out |= {"ATE [m]": judged.ate_m, "end error [m]": judged.end_error_m}
    out["path [m]"] = trajectory.length_m
    if sequence.forward_speed_m_s is not None:
        driven_m = float(np.trapezoid(sequence.forward_speed_m_s, sequence.stamps_ns / 1e9))
        if driven_m > 1:
            out["against forward speed [%]"] = 100 * (trajectory.length_m / driven_m - 1)
    out["moved [m]"] = float(np.linalg.norm(trajectory.poses[-1, :3, 3]))
    median, p90 = np.percentile(ran.ms, [50, 90]).tolist()
    return out | {"median [ms]": median, "p90 [ms]": p90, "times ours": median / ours_ms}


def _judged(trajectory: Trajectory, sequence: Sequence) -> Evaluation | None:
    if sequence.reference is None or sequence.reference.length_m < 1:
        return None
    try:
        return evaluate(sequence.reference, trajectory)
    except HybridLioError as error:
        print(f"not judged: {error}")
        return None


def markdown(rows: list[dict[str, Any]]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = [names, ["---"] + ["---:"] * (len(names) - 1)]
    lines += [[_cell(row.get(name)) for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else "–" if value is None else str(value)


def circumstances(sequence: Sequence, options: argparse.Namespace) -> dict[str, Any]:
    packages = ("hybridlio", "kiss-icp", "rko_lio", "small_gicp", "gtsam", "numpy")
    found = {p.metadata["Name"]: p.version for p in metadata.distributions() if p.metadata["Name"] in packages}
    reference = sequence.reference
    return {
        "sequence": sequence.name,
        "scans": len(sequence),
        "reference_length_m": None if reference is None else reference.length_m,
        "threads": options.threads,
        "repeats": options.repeats,
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "machine": platform.machine(),
        "packages": found,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--frames", metavar="A:B")
    parser.add_argument("--initial-pose", default="preintegration", metavar="A,B,…")
    parser.add_argument("--residual", default="scan-matching", metavar="A,B,…")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    sequence = part_of(open_sequence(options.data, sequence=options.sequence), options.frames)
    chosen = systems(sequence, options)
    runs = {name: Ran(name) for name in chosen}
    for repeat in range(options.repeats):
        for name, make in chosen.items():
            print(f"{name}, pass {repeat + 1} of {options.repeats}", flush=True)
            run(name, make, sequence, runs[name])
    ours_ms = float(np.median(next(iter(runs.values())).ms))
    rows = [figures(ran, sequence, ours_ms) for ran in runs.values()]
    said = circumstances(sequence, options)
    head = ", ".join(f"{key} {value}" for key, value in said.items() if key not in ("packages", "machine"))
    text = f"{head}\n\n{markdown(rows)}\n"
    print(f"\n{text}")
    if options.out is not None:
        write_whole(options.out / "peers.md", text)
        write_whole(options.out / "peers.json", json.dumps({**said, "systems": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
