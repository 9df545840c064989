"""Run hybridlio and other systems on simulated hard cases; see benchmarks/README.md.

    python benchmarks/scenarios.py FOLDER [--scenarios normal,corridor,…] [--seeds 7301,7306] [--length-m 300] [-o DIR]

Drives that FOLDER lacks are simulated. Each system's drift is divided by its own drift in `normal` of the same seeds.
For hybridlio the tables also give the share of scans that it reports as degenerate (a direction is unconstrained),
bridged (the scan was not used) or disagreed (scan and IMU contradict each other), the standard deviation of the last
position beside its error, and the ANEES of its poses (1 is consistent, more is overconfident).
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
from common import Figures, circumstances, drift_of, evaluation_of, table_of
from lockstep import Pass, run_in_lockstep
from systems import add_system_options, chosen_systems

from hybridlio.commands.terminal import progress
from hybridlio.core.files import write_atomically
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.scenarios import SCENARIOS, open_scenario

_NORMAL = "normal"
_HELD = 2.0  # times the normal drift, which itself differs about as much between seeds (0.016 to 0.035 %)
_MEANS = {  # columns that are means over the seeds
    "end error [m]": "end_error_m",
    "σ of the end [m]": "end_sigma_m",
    "degenerate": "degenerate",
    "bridged": "bridged",
    "disagreed": "disagreed",
    "ANEES rotation": "anees_rotation",
    "ANEES position": "anees_position",
}


def figures(run: Pass, sequence: Sequence) -> Figures:
    """Return the drift of a run, and what the system itself reports."""
    if run.error is not None or len(run.answers) < 2:
        return {"completed": False, "why": run.error}
    trajectory, answers = run.trajectory(), run.answers[1:]
    evaluation = evaluation_of(trajectory, sequence)
    if evaluation is None:
        return {"completed": False, "why": "not evaluated"}
    t_rel, r_rel = drift_of(evaluation)
    out: Figures = {"completed": True, "t_rel": t_rel, "r_rel": r_rel, "end_error_m": evaluation.end_error_m}
    if trajectory.covariances is None:
        return out
    return out | {
        "end_sigma_m": float(np.sqrt(trajectory.covariances[-1, 3:, 3:].trace())),
        "degenerate": float(np.mean([answer.degenerate for answer in answers])),
        "bridged": float(np.mean([answer.bridged for answer in answers])),
        "disagreed": float(np.mean([answer.disagreed for answer in answers])),
        "anees_rotation": evaluation.anees_rotation,
        "anees_position": evaluation.anees_position,
    }


def measure(scenario: str, seed: int, options: argparse.Namespace) -> dict[str, Figures]:
    """Return every system's figures in one scenario of one seed, ours first."""
    opened = partial(open_scenario, scenario, options.folder, seed, options.length_m)
    with progress(f"simulating {scenario} {seed}") as tick:
        sequence = opened(tick)
    systems = chosen_systems(options, sequence)
    with progress(f"{scenario} {seed}") as tick:
        passes = run_in_lockstep(systems, opened, len(sequence), options.threads, tick)
    return {name: figures(run, sequence) for name, run in passes.items()}


def summary(found: list[Figures], normal: list[Figures]) -> Figures:
    """Return one system's means over all seeds of a scenario, and the verdict."""
    complete = all(run["completed"] for run in found)
    out: Figures = {"completed": f"{sum(run['completed'] for run in found)} of {len(found)}"}
    out |= {"why not": next((run.get("why") for run in found if not run["completed"]), None)}
    if not complete:
        return out
    t_rel = mean("t_rel", found)
    normal_t_rel = mean("t_rel", normal) if all(run["completed"] for run in normal) else None
    ratio = t_rel / normal_t_rel if t_rel is not None and normal_t_rel else None
    out |= {"t_rel [%]": t_rel, "r_rel [°/100 m]": mean("r_rel", found), "times normal": ratio}
    out |= {heading: mean(key, found) for heading, key in _MEANS.items()}
    if ratio is not None and found[0].get("end_sigma_m") is not None:
        out["verdict"] = "held" if ratio <= _HELD else "reported" if is_reported(found, normal) else "not reported"
    return out


def mean(key: str, runs: list[Figures]) -> float | None:
    values = [run[key] for run in runs if run.get(key) is not None]
    return float(np.mean(values)) if values else None


def is_reported(found: list[Figures], normal: list[Figures]) -> bool:
    """Return whether the runs flag any scan, or end with a much larger covariance than the normal ones."""
    flagged = max(mean(key, found) or 0.0 for key in ("degenerate", "bridged", "disagreed"))
    return flagged > 0 or (mean("end_sigma_m", found) or 0.0) > _HELD * (mean("end_sigma_m", normal) or np.inf)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the simulated drives")
    parser.add_argument("--scenarios", default=",".join(SCENARIOS), metavar="A,B,…", help="(default: all)")
    parser.add_argument("--seeds", default="7301,7306", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--length-m", type=float, default=300.0, help="of each drive (default: %(default)s)")
    add_system_options(parser)
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="for a table of each scenario and scenarios.json")
    parser.set_defaults(repeats=1)
    return parser.parse_args()


def main() -> None:
    options = parsed()
    seeds = [int(seed) for seed in options.seeds.split(",")]
    scenarios = [_NORMAL, *(name for name in options.scenarios.split(",") if name and name != _NORMAL)]
    found: dict[str, dict[str, list[Figures]]] = {}
    for scenario in scenarios:
        by_seed = [measure(scenario, seed, options) for seed in seeds]
        found[scenario] = {name: [runs[name] for runs in by_seed] for name in by_seed[0]}
        rows = {name: summary(runs, found[_NORMAL][name]) for name, runs in found[scenario].items()}
        text = f"{scenario}: {SCENARIOS[scenario].description}\n\n{table_of(rows, ('system', 'verdict'))}\n"
        print(f"\n{text}", flush=True)
        if options.out is not None:
            write_atomically(options.out / f"{scenario}.md", text)
    if options.out is not None:
        content = {**circumstances(options), "seeds": seeds, "length_m": options.length_m, "scenarios": found}
        write_atomically(options.out / "scenarios.json", json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
