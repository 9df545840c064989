"""hybridlio beside KISS-ICP, RKO-LIO, small_gicp and Open3D's ICP on the same scans; benchmarks/README.md says more.

    pip install 'hybridlio[peers]'
    python benchmarks/peers.py DATA [--sequence 0005] [--frames 0:100] [--repeats 3] [-o DIR]
    python benchmarks/peers.py DRIVE_A DRIVE_B … -o DIR        # and how they compare on average

Each system runs in a process of its own, all in lockstep: one scan of one system at a time, with the same number of
threads. Each gets scans that are already read, as it wants them; timed is the call that takes a scan (and, where it
takes them, the inertial samples). With -o the table goes to peers.md and every figure to peers.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from lockstep import Pass, resident_growth_mb, run_in_lockstep
from systems import PEERS, Array, Make, our_systems, peer_systems

from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.errors import HybridLioError
from hybridlio.core.files import write_atomically
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.evaluation.evaluate import Evaluation, evaluate

Figures = dict[str, Any]

_DRIFT = "t_rel [%]"
_A_SECOND = 10  # scans


def opened(data: Path, sequence: str | None, frames: str | None) -> Sequence:
    return part_of(open_sequence(data, sequence=sequence), frames)


def trajectory_of(one: Pass) -> Trajectory:
    poses = np.array([answer.pose for answer in one.answers])
    stamps = np.array([answer.stamp_ns for answer in one.answers])
    given = [answer.covariance for answer in one.answers if answer.covariance is not None]
    return Trajectory(stamps, se3.between(poses[0], poses), np.array(given) if len(given) == len(poses) else None)


def judged(trajectory: Trajectory, sequence: Sequence) -> Evaluation | None:
    if sequence.reference is None or sequence.reference.length_m < 1:
        return None
    try:
        return evaluate(sequence.reference, trajectory)
    except HybridLioError as error:
        print(f"not judged: {error}")
        return None


def drift_of(judgement: Evaluation) -> tuple[float | None, float | None]:
    """Drift over KITTI's lengths, or over those that fit a shorter path."""
    if judgement.t_rel_percent is not None:
        return judgement.t_rel_percent, judgement.r_rel_deg_per_100m
    return judgement.chosen_t_rel_percent, judgement.chosen_r_rel_deg_per_100m


def ahead_of_speed(trajectory: Trajectory, sequence: Sequence) -> tuple[Array, float]:
    """How much farther forward ``(N,)`` each scan is than the forward speed has driven, and what that drives in all.

    Both in metres, and of the navigation unit: the lidar, ahead of it, goes a longer way in bends. Errors of either
    sign add up to nothing in the end: what single seconds are off by tells more.
    """
    seconds, speed = sequence.stamps_ns / 1e9, sequence.forward_speed_m_s
    assert speed is not None
    driven_m = np.diff(seconds) * (speed[1:] + speed[:-1]) / 2
    poses = trajectory.poses @ se3.inverse(sequence.calibration.T_imu_lidar)
    steps = se3.between(poses[:-1], poses[1:])
    halfway = se3.so3_exp(se3.so3_log(steps[:, :3, :3]) / 2)
    forward_m = np.einsum("nji,nj->ni", halfway, steps[:, :3, 3])[:, 0]
    return np.concatenate([[0.0], np.cumsum(forward_m - driven_m)]), float(driven_m.sum())


def accuracy(one: Pass, sequence: Sequence) -> Figures:
    """How well, as far as the recording's references bear it; nothing of a system that did not reach the end."""
    if len(one.answers) < 2 or one.error is not None:
        return {}
    trajectory, out = trajectory_of(one), {}
    judgement = judged(trajectory, sequence)
    if judgement is not None:
        out[_DRIFT], out["r_rel [°/100 m]"] = drift_of(judgement)
        out |= {"ATE [m]": judgement.ate_m, "end error [m]": judgement.end_error_m}
    out["path [m]"] = trajectory.length_m
    if sequence.forward_speed_m_s is not None and len(trajectory) == len(sequence):
        ahead_m, driven_m = ahead_of_speed(trajectory, sequence)
        if driven_m > 1:
            out["against forward speed [%]"] = 100 * float(ahead_m[-1] / driven_m)
            out["the same over 1 s, RMS [mm]"] = 1e3 * float(
                np.sqrt(np.mean((ahead_m[_A_SECOND:] - ahead_m[:-_A_SECOND]) ** 2))
            )
        else:
            out["moved though standing [m]"] = trajectory.length_m
            away_mm = 1e3 * np.linalg.norm(trajectory.poses[:, :3, 3], axis=1)
            out["away from the start, RMS [mm]"] = float(np.sqrt(np.mean(away_mm**2)))
            out["at the end [mm]"] = float(away_mm[-1])
    return out


def cost(passes: list[Pass], ours: list[Pass]) -> Figures:
    """How quickly and in how much memory: medians of the repeats, and how far apart their ratios to ours are."""
    passes = [one for one in passes if one.ms]
    if not passes:
        return {}
    medians, first = [np.median(one.ms) for one in passes], [np.median(one.ms) for one in ours]
    ratios = [theirs / mine for theirs, mine in zip(medians, first, strict=False)]
    of = list(zip(passes, ours, strict=False))
    return {
        "median [ms]": float(np.median(medians)),
        "p90 [ms]": float(np.median([np.percentile(one.ms, 90) for one in passes])),
        "times ours": float(np.median(ratios)),
        "least": float(min(ratios)),
        "most": float(max(ratios)),
        "p90 times ours": float(np.median([np.percentile(a.ms, 90) / np.percentile(b.ms, 90) for a, b in of])),
        "CPU times ours": float(np.median([np.mean(a.cpu_ms) / np.mean(b.cpu_ms) for a, b in of])),
        "start to first pose [s]": float(np.median([one.start_s for one in passes])),
        "peak memory [MB]": float(np.median([one.peak_mb for one in passes])),
        "memory growth [MB]": float(np.median([resident_growth_mb(one) for one in passes])),
    }


def compared(data: Path, options: argparse.Namespace) -> tuple[Sequence, dict[str, Figures]]:
    """Every system's figures on one recording, ours first."""
    sequence = opened(data, options.sequence, options.frames)
    systems: dict[str, Make] = our_systems(options.initial_pose, options.residual, options.backend)
    systems |= peer_systems(options.peers, sequence)
    again = partial(opened, data, options.sequence, options.frames)
    runs: dict[str, list[Pass]] = {name: [] for name in systems}
    for repeat in range(options.repeats):
        with progress(f"{sequence.name}, pass {repeat + 1} of {options.repeats}") as tick:
            for name, one in run_in_lockstep(systems, again, len(sequence), options.threads, tick).items():
                runs[name].append(one)
    ours = next(iter(runs.values()))
    rows = {}
    for name, passes in runs.items():
        failed = next((one.error for one in passes if one.error), None)
        rows[name] = accuracy(passes[-1], sequence) | cost(passes, ours) | ({"ended early": failed} if failed else {})
    return sequence, rows


def words(rows: dict[str, Figures]) -> list[dict[str, str]]:
    def word(value: object) -> str:
        return f"{value:.3f}" if isinstance(value, float) else tables.NOTHING if value is None else str(value)

    return [{"system": name, **{key: word(value) for key, value in row.items()}} for name, row in rows.items()]


def averages(recordings: dict[str, dict[str, Figures]]) -> dict[str, Figures]:
    """Of each system: mean drift over all recordings, and ours over it on average and at worst."""
    systems = list(next(iter(recordings.values())))
    out: dict[str, Figures] = {}
    for name in systems:
        theirs = np.array([rows[name].get(_DRIFT, np.nan) for rows in recordings.values()], dtype=float)
        mine = np.array([rows[systems[0]].get(_DRIFT, np.nan) for rows in recordings.values()], dtype=float)
        out[name] = {
            "mean t_rel [%]": float(theirs.mean()),
            "ours / its, of the means": float(mine.mean() / theirs.mean()),
            "mean of ours / its": float((mine / theirs).mean()),
            "worst ours / its": float((mine / theirs).max()),
            "mean times ours": float(np.mean([rows[name].get("times ours", np.nan) for rows in recordings.values()])),
        }
    return out


def circumstances(options: argparse.Namespace) -> Figures:
    packages = ("hybridlio", "kiss-icp", "rko_lio", "small_gicp", "open3d", "gtsam", "numpy")
    found = {p.metadata["Name"]: p.version for p in metadata.distributions() if p.metadata["Name"] in packages}
    return {
        "threads": options.threads,
        "repeats": options.repeats,
        "cores": os.cpu_count(),
        "load": [round(value, 1) for value in os.getloadavg()],
        "machine": platform.machine(),
        "packages": found,
    }


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--sequence")
    parser.add_argument("--frames", metavar="A:B")
    parser.add_argument("--initial-pose", default="preintegration", metavar="A,B,…", help="or each")
    parser.add_argument("--residual", default="scan-matching", metavar="A,B,…", help="or each")
    parser.add_argument("--backend", default="fixed-lag", metavar="A,B,…", help="or each")
    parser.add_argument("--peers", default=",".join(PEERS), metavar="A,B,…", help="'' for none")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("-o", "--out", type=Path)
    return parser.parse_args()


def main() -> None:
    options = parsed()
    said, recordings, parts = circumstances(options), {}, []
    told: Figures = {}
    for data in options.data:
        sequence, rows = compared(data, options)
        name = sequence.name if sequence.name not in recordings else str(data)
        length = "" if sequence.reference is None else f", {sequence.reference.length_m:.0f} m"
        recordings[name] = rows
        told[name] = {"scans": len(sequence), "systems": rows}
        parts.append(f"{name}: {len(sequence)} scans{length}\n\n{tables.to_markdown(words(rows), ('system',))}\n")
        print(f"\n{parts[-1]}", flush=True)
    if len(recordings) > 1:
        parts.append(f"all of them\n\n{tables.to_markdown(words(averages(recordings)), ('system',))}\n")
        print(f"\n{parts[-1]}")
    head = ", ".join(f"{key} {value}" for key, value in said.items() if key not in ("packages", "machine"))
    if options.out is not None:
        write_atomically(options.out / "peers.md", "\n".join([head + "\n", *parts]))
        write_atomically(options.out / "peers.json", json.dumps({**said, "recordings": told}, indent=2) + "\n")


if __name__ == "__main__":
    main()
