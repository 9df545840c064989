"""Compare hybridlio with KISS-ICP and RKO-LIO on other platforms than road vehicles; see benchmarks/README.md.

    pip install 'hybridlio[peers]'
    python benchmarks/platforms.py FOLDER [--kinds office-handheld,campus-drone] [--lidars os0,mid360] [--seeds 1,2]

A cell is a kind of recording (scene and platform), a lidar and a seed. It is simulated below FOLDER unless it is there.
hybridlio runs with its defaults, and all systems go through a cell in lockstep (`lockstep.py`). A finished cell is kept
in FOLDER/cells, and the same command goes on where it stopped; remove a cell's file to measure it again. Errors are
those of each pose against the exact one at the pose's own stamp.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from common import Figures, circumstances, open_part, table_of
from lockstep import Pass, run_in_lockstep
from systems import add_system_options, chosen_systems, kiss_icp

from hybridlio.commands.terminal import progress
from hybridlio.core.errors import HybridLioError
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.evaluate import Evaluation, evaluate
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.recording import PlatformRecording, plan
from hybridlio.simulation.platforms.scenes.table import SCENES
from hybridlio.simulation.platforms.simulate import simulate_platform

KINDS = [*(f"{name}-{scene.platform}" for name, scene in SCENES.items()), "campus-drone"]
_OVER_M = 10.0  # the drift is that over this distance: far for a room, near for a street
_ATE, _DRIFT = "ATE [m]", "drift over 10 m [%]"


@dataclass(frozen=True)
class Cell:
    """A recording that all systems run on."""

    config: PlatformConfig
    folder: Path

    @property
    def result(self) -> Path:
        """The file of the cell's figures."""
        return self.folder / "cells" / f"{self.config.name}.json"


def evaluation_of(run: Pass, recording: PlatformRecording) -> Evaluation | str:
    """Evaluate against the exact poses at the stamps of the answers, or say why that is not possible."""
    if run.error is not None:
        return run.error
    estimate = run.trajectory()
    truth = recording.lidar_poses((estimate.stamps_ns - START_NS) / NS_PER_S)
    try:
        return evaluate(estimate, Trajectory(estimate.stamps_ns, truth).from_first(), [_OVER_M])
    except HybridLioError as error:
        return str(error)


def figures(run: Pass, recording: PlatformRecording) -> Figures:
    """Return one system's row in a cell."""
    found = evaluation_of(run, recording)
    if isinstance(found, str):
        return {"completed": "no", "why not": found}
    out: Figures = {"completed": "yes", _ATE: found.ate_m, _DRIFT: found.chosen_t_rel_percent}
    out |= {"end error [m]": found.end_error_m}
    if found.anees_position is not None:
        answers = run.answers[1:]
        out["bridged [%]"] = 100 * float(np.mean([answer.bridged for answer in answers]))
        out["contradicted [%]"] = 100 * float(np.mean([answer.disagreed for answer in answers]))
        out |= {"ANEES position": found.anees_position, "ANEES rotation": found.anees_rotation}
    return out | {"median [ms]": float(np.median(run.ms)), "p90 [ms]": float(np.percentile(run.ms, 90))}


def measure(cell: Cell, options: argparse.Namespace) -> dict[str, Figures]:
    """Return every system's figures in a cell, ours first; from its file if it was measured before."""
    settings = json.loads(cell.config.model_dump_json())
    if cell.result.is_file():
        kept = json.loads(cell.result.read_text())
        if kept["config"] != settings:
            raise SystemExit(f"{cell.result} was measured with other settings; choose another folder")
        return dict(kept["systems"])
    with progress(f"simulating {cell.config.name}") as tick:
        folder = simulate_platform(cell.folder / "recordings", cell.config, tick)
    opened = partial(open_part, folder, None, None)
    sequence = opened()
    systems = chosen_systems(options, sequence)
    if "kiss-icp" in systems:  # its authors set the range by the sensor, and the voxels by the range
        most = SCANNERS[cell.config.lidar].model.max_range_m
        systems["kiss-icp"] = partial(kiss_icp, max_range_m=min(most, 100.0))
    with progress(cell.config.name) as tick:
        passes = run_in_lockstep(systems, opened, len(sequence), options.threads, tick)
    recording = plan(cell.config)
    rows = {name: figures(run, recording) for name, run in passes.items()}
    content = {**circumstances(options), "config": settings, "systems": rows}
    write_atomically(cell.result, json.dumps(content, indent=2) + "\n")
    return rows


def summary(cells: dict[str, dict[str, Figures]]) -> dict[str, Figures]:
    """Return for each system the means over all cells, and the mean and worst ratio of ours to it."""
    names = list(next(iter(cells.values())))
    out: dict[str, Figures] = {}
    for name in names:
        rows = [rows[name] for rows in cells.values()]
        pairs = [(rows[names[0]], rows[name]) for rows in cells.values()]
        out[name] = {"completed": f"{sum(row['completed'] == 'yes' for row in rows)} of {len(rows)}"}
        for heading in (_ATE, _DRIFT, "median [ms]", "p90 [ms]"):
            values = [row[heading] for row in rows if row.get(heading) is not None]
            ratios = [mine[heading] / row[heading] for mine, row in pairs if mine.get(heading) and row.get(heading)]
            short = heading.split(" [")[0]
            out[name] |= {
                heading: float(np.mean(values)) if values else None,
                f"{short}, ours / its": float(np.mean(ratios)) if ratios else None,
                f"{short}, worst": float(np.max(ratios)) if ratios else None,
            }
    return out


def cells_of(options: argparse.Namespace) -> list[Cell]:
    """Return the cells that the options select, seed by seed, so that an early stop has seen all kinds."""
    kinds = [kind.rsplit("-", 1) for kind in options.kinds.split(",")]
    return [
        Cell(
            PlatformConfig(
                scene=scene, platform=body, lidar=lidar, imu=options.imu, seconds=options.seconds, seed=int(seed)
            ),
            options.folder,
        )
        for seed in options.seeds.split(",")
        for scene, body in kinds
        for lidar in options.lidars.split(",")
    ]


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for recordings and results")
    parser.add_argument("--kinds", default=",".join(KINDS), metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--lidars", default="os0,mid360,rosette,vlp-16", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--imu", default="consumer-mems", help="(default: %(default)s)")
    parser.add_argument("--seeds", default="8001,8002,8003,8004,8005", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each recording (default: %(default)s)")
    add_system_options(parser)
    parser.set_defaults(repeats=1, peers="rko_lio,kiss-icp")
    return parser.parse_args()


def main() -> None:
    options, found, parts = parsed(), {}, []
    for cell in cells_of(options):
        found[cell.config.name] = measure(cell, options)
        parts.append(f"{cell.config.name}\n\n{table_of(found[cell.config.name], ('system', 'why not'))}\n")
        print(f"\n{parts[-1]}", flush=True)
    parts.append(f"all {len(found)} cells\n\n{table_of(summary(found))}\n")
    print(f"\n{parts[-1]}")
    write_atomically(options.folder / "platforms.md", "\n".join(parts))


if __name__ == "__main__":
    main()
