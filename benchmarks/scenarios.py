"""Hard cases, hybridlio and its peers side by side; benchmarks/README.md says more.

    python benchmarks/scenarios.py FOLDER [--scenarios normal,corridor,…] [--seeds 7301,7306] [--length-m 300] [-o DIR]

The drives are simulated below FOLDER unless they are there. Each system's drift is held against its own in `normal`
of the same seed. hybridlio also says of which share of scans it could not see enough (degenerate: a direction left
open; bridged: of no use; disagreed: scan and IMU contradict each other), and how sure it is: σ at the end beside the
error there, and the average normalised error squared of its poses (1 is the truth, more is too sure).
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lockstep import Pass, run_in_lockstep
from peers import circumstances, drift_of, judged, trajectory_of, words
from systems import PEERS, our_systems, peer_systems

from hybridlio.commands.terminal import progress
from hybridlio.core import tables
from hybridlio.core.files import write_atomically
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.scenarios import SCENARIOS, open_scenario

Figures = dict[str, Any]

_NORMAL = "normal"
_ALLOWED = 2.0


def figures(one: Pass, sequence: Sequence) -> Figures:
    """Drift, and what the system says of itself."""
    if one.error is not None or len(one.answers) < 2:
        return {"completed": False, "why": one.error}
    trajectory, marks = trajectory_of(one), one.answers[1:]
    judgement = judged(trajectory, sequence)
    if judgement is None:
        return {"completed": False, "why": "not judged"}
    drift, turn = drift_of(judgement)
    out: Figures = {"completed": True, "t_rel": drift, "r_rel": turn, "end_error_m": judgement.end_error_m}
    if trajectory.covariances is None:
        return out
    return out | {
        "end_sigma_m": float(np.sqrt(trajectory.covariances[-1, 3:, 3:].trace())),
        "degenerate": float(np.mean([answer.degenerate for answer in marks])),
        "bridged": float(np.mean([answer.bridged for answer in marks])),
        "disagreed": float(np.mean([answer.disagreed for answer in marks])),
        "anees_rotation": judgement.anees_rotation,
        "anees_position": judgement.anees_position,
    }


def measured(scenario: str, seed: int, options: argparse.Namespace) -> dict[str, Figures]:
    """Every system's figures in one scenario of one seed, ours first."""
    opened = partial(open_scenario, scenario, options.folder, seed, options.length_m)
    with progress(f"simulating {scenario} {seed}") as tick:
        sequence = opened(tick)
    systems = our_systems(options.initial_pose, options.residual, options.backend)
    systems |= peer_systems(options.peers, sequence)
    with progress(f"{scenario} {seed}") as tick:
        passes = run_in_lockstep(systems, opened, len(sequence), options.threads, tick)
    return {name: figures(one, sequence) for name, one in passes.items()}


def summary(found: list[Figures], normal: list[Figures]) -> Figures:
    """One system in one scenario over all seeds: means, and the verdict on it."""
    complete = all(one["completed"] for one in found)
    out: Figures = {"completed": f"{sum(one['completed'] for one in found)} of {len(found)}"}
    out |= {"why not": next((one.get("why") for one in found if not one["completed"]), None)}
    if not complete:
        return out

    def mean(key: str, of: list[Figures]) -> float | None:
        values = [one[key] for one in of if one.get(key) is not None]
        return float(np.mean(values)) if values else None

    drift, own = mean("t_rel", found), mean("t_rel", normal) if all(one["completed"] for one in normal) else None
    ratio = drift / own if drift is not None and own else None
    out |= {"t_rel [%]": drift, "r_rel [°/100 m]": mean("r_rel", found), "to own normal": ratio}
    for heading, key in (
        ("end error [m]", "end_error_m"), ("σ there [m]", "end_sigma_m"), ("degenerate", "degenerate"),
        ("bridged", "bridged"), ("disagreed", "disagreed"),
        ("ANEES rotation", "anees_rotation"), ("ANEES position", "anees_position"),
    ):  # fmt: skip
        out[heading] = mean(key, found)
    if ratio is not None and found[0].get("end_sigma_m") is not None:
        said = max(out["degenerate"], out["bridged"], out["disagreed"]) > 0 or out["σ there [m]"] > _ALLOWED * (
            mean("end_sigma_m", normal) or np.inf
        )
        out["verdict"] = "held" if ratio <= _ALLOWED else "reported" if said else "drifted in silence"
    return out


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenarios", default=",".join(SCENARIOS), metavar="A,B,…")
    parser.add_argument("--seeds", default="7301,7306", metavar="A,B,…")
    parser.add_argument("--length-m", type=float, default=300.0)
    parser.add_argument("--initial-pose", default="preintegration", metavar="A,B,…")
    parser.add_argument("--residual", default="scan-matching", metavar="A,B,…")
    parser.add_argument("--backend", default="fixed-lag", metavar="A,B,…")
    parser.add_argument("--peers", default=",".join(PEERS), metavar="A,B,…", help="'' for none")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("-o", "--out", type=Path)
    parser.set_defaults(repeats=1)
    return parser.parse_args()


def main() -> None:
    options = parsed()
    seeds = [int(seed) for seed in options.seeds.split(",")]
    asked = [_NORMAL, *(name for name in options.scenarios.split(",") if name and name != _NORMAL)]
    found: dict[str, dict[str, list[Figures]]] = {}
    for scenario in asked:
        by_seed = [measured(scenario, seed, options) for seed in seeds]
        found[scenario] = {name: [one[name] for one in by_seed] for name in by_seed[0]}
        said = {name: summary(rows, found[_NORMAL][name]) for name, rows in found[scenario].items()}
        table = tables.to_markdown(words(said), ("system", "verdict"))
        text = f"{scenario}: {SCENARIOS[scenario].description}\n\n{table}\n"
        print(f"\n{text}", flush=True)
        if options.out is not None:
            write_atomically(options.out / f"{scenario}.md", text)
    if options.out is not None:
        content = {**circumstances(options), "seeds": seeds, "length_m": options.length_m, "scenarios": found}
        write_atomically(options.out / "scenarios.json", json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
