"""Compare hybridlio with KISS-ICP, RKO-LIO, small_gicp and Open3D's ICP on the same scans; see benchmarks/README.md.

    pip install 'hybridlio[peers]'
    python benchmarks/peers.py DATA [--sequence 0005] [--frames 0:100] [--repeats 3] [-o DIR]
    python benchmarks/peers.py DRIVE_A DRIVE_B … -o DIR        # with a table of averages

Each system runs in its own process, all in lockstep: one scan of one system at a time, with the same number of threads.
Scans are read and converted beforehand. The measured time is that of the call that takes the scan and, where the system
uses them, the inertial samples. With -o the tables go to peers.md and all figures to peers.json.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
from common import Figures, circumstances, drift_of, evaluation_of, forward_error, open_part, table_of
from lockstep import Pass, run_in_lockstep
from systems import add_system_options, chosen_systems

from hybridlio.commands.terminal import progress
from hybridlio.core.arrays import Array
from hybridlio.core.files import write_atomically
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence

_DRIFT, _RATIO = "t_rel [%]", "times ours"
_SCANS_PER_S = 10


def accuracy(run: Pass, sequence: Sequence) -> Figures:
    """Return errors against the recording's references; nothing for a system that did not reach the end."""
    if len(run.answers) < 2 or run.error is not None:
        return {}
    trajectory, out = run.trajectory(), {}
    evaluation = evaluation_of(trajectory, sequence)
    if evaluation is not None:
        out[_DRIFT], out["r_rel [°/100 m]"] = drift_of(evaluation)
        out |= {"ATE [m]": evaluation.ate_m, "end error [m]": evaluation.end_error_m}
    out["path [m]"] = trajectory.length_m
    if sequence.forward_speed_m_s is not None and len(trajectory) == len(sequence):
        out |= accuracy_by_speed(trajectory, sequence)
    return out


def accuracy_by_speed(trajectory: Trajectory, sequence: Sequence) -> Figures:
    """Return the error of the distance travelled by the recorded forward speed, or the motion of a standing vehicle."""
    error_m, driven_m = forward_error(trajectory, sequence)
    if driven_m > 1:
        over_1_s_mm = 1e3 * (error_m[_SCANS_PER_S:] - error_m[:-_SCANS_PER_S])
        return {
            "distance error by speed [%]": 100 * float(error_m[-1] / driven_m),
            "distance error over 1 s, RMS [mm]": rms(over_1_s_mm) if len(over_1_s_mm) else None,
        }
    from_start_mm = 1e3 * np.linalg.norm(trajectory.poses[:, :3, 3], axis=1)
    return {
        "path while standing [m]": trajectory.length_m,
        "distance from start, RMS [mm]": rms(from_start_mm),
        "distance from start, end [mm]": float(from_start_mm[-1]),
    }


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def cost(passes: list[Pass], ours: list[Pass]) -> Figures:
    """Return time and memory: medians over the repeats, and the range of the repeats' ratios to ours."""
    passes = [run for run in passes if run.ms]
    if not passes:
        return {}
    medians, our_medians = [np.median(run.ms) for run in passes], [np.median(run.ms) for run in ours]
    ratios = [theirs / mine for theirs, mine in zip(medians, our_medians, strict=False)]
    pairs = list(zip(passes, ours, strict=False))
    return {
        "median [ms]": float(np.median(medians)),
        "p90 [ms]": float(np.median([np.percentile(run.ms, 90) for run in passes])),
        _RATIO: float(np.median(ratios)),
        "least": float(min(ratios)),
        "most": float(max(ratios)),
        "p90 times ours": float(np.median([np.percentile(a.ms, 90) / np.percentile(b.ms, 90) for a, b in pairs])),
        "CPU times ours": float(np.median([np.mean(a.cpu_ms) / np.mean(b.cpu_ms) for a, b in pairs])),
        "start to first pose [s]": float(np.median([run.start_s for run in passes])),
        "peak memory [MiB]": float(np.median([run.peak_mib for run in passes])),
        "memory growth [MiB]": float(np.median([run.memory_growth_mib() for run in passes])),
    }


def compare(data: Path, options: argparse.Namespace) -> tuple[Sequence, dict[str, Figures]]:
    """Return a recording and every system's figures on it, ours first."""
    opened = partial(open_part, data, options.sequence, options.frames)
    sequence = opened()
    systems = chosen_systems(options, sequence)
    runs: dict[str, list[Pass]] = {name: [] for name in systems}
    for repeat in range(options.repeats):
        with progress(f"{sequence.name}, pass {repeat + 1} of {options.repeats}") as tick:
            for name, run in run_in_lockstep(systems, opened, len(sequence), options.threads, tick).items():
                runs[name].append(run)
    ours = next(iter(runs.values()))
    rows = {}
    for name, passes in runs.items():
        failure = next((run.error for run in passes if run.error), None)
        rows[name] = accuracy(passes[-1], sequence) | cost(passes, ours) | ({"ended early": failure} if failure else {})
    return sequence, rows


def averages(recordings: dict[str, dict[str, Figures]]) -> dict[str, Figures]:
    """Return, for each system, the mean drift over all recordings, and the mean and worst ratio of ours to it."""
    systems = list(next(iter(recordings.values())))

    def column(name: str, heading: str) -> Array:
        return np.array([rows[name].get(heading, np.nan) for rows in recordings.values()], dtype=float)

    mine, out = column(systems[0], _DRIFT), {}
    for name in systems:
        theirs = column(name, _DRIFT)
        out[name] = {
            "mean t_rel [%]": float(theirs.mean()),
            "ratio of means, ours / its": float(mine.mean() / theirs.mean()),
            "mean ratio, ours / its": float((mine / theirs).mean()),
            "worst ratio, ours / its": float((mine / theirs).max()),
            "mean times ours": float(np.mean(column(name, _RATIO))),
        }
    return out


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+", help="recordings")
    parser.add_argument("--sequence", help="which one, if a folder holds several")
    parser.add_argument("--frames", metavar="A:B", help="a part of each recording")
    parser.add_argument("--repeats", type=int, default=1, help="passes over each recording (default: %(default)s)")
    add_system_options(parser)
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="for peers.md and peers.json")
    return parser.parse_args()


def main() -> None:
    options = parsed()
    conditions, recordings, parts = circumstances(options), {}, []
    found: Figures = {}
    for data in options.data:
        sequence, rows = compare(data, options)
        name = sequence.name if sequence.name not in recordings else str(data)
        length = "" if sequence.reference is None else f", {sequence.reference.length_m:.0f} m"
        recordings[name] = rows
        found[name] = {"scans": len(sequence), "systems": rows}
        parts.append(f"{name}: {len(sequence)} scans{length}\n\n{table_of(rows)}\n")
        print(f"\n{parts[-1]}", flush=True)
    if len(recordings) > 1:
        parts.append(f"averages over the recordings\n\n{table_of(averages(recordings))}\n")
        print(f"\n{parts[-1]}")
    head = ", ".join(f"{key} {value}" for key, value in conditions.items() if key not in ("packages", "machine"))
    if options.out is not None:
        write_atomically(options.out / "peers.md", "\n".join([head + "\n", *parts]))
        write_atomically(options.out / "peers.json", json.dumps({**conditions, "recordings": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
