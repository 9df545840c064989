"""The fault matrix on other drives than that of the tests: errors by the run's own covariances, and what is said.

    python benchmarks/fault_matrix.py FOLDER [--seeds 121,131] [--rows WORDS,…]
    python benchmarks/fault_matrix.py FOLDER --platforms office-os0,campus-mid360 --seeds 121

Each row of tests/helpers/fault_rows.py whose name holds one of the WORDS (default: all) is put into a drive of each
seed. Prints a line for each run: the largest horizontal error, the shares of the positions beyond three standard
deviations and with a normalised squared error over 25, and whether anything is said. The pooled share at the end leaves
out what runs with `--no-check`, as the tests do. The drives are simulated in FOLDER, unless it holds them.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/helpers"))

from fault_rows import FLAGGED, LONG, SURVIVED, Row
from fault_runs import GROSS_NEES, Outcome, run_row

from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation import SimulationConfig, simulate
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.simulate import simulate_platform

_ROWS = {**SURVIVED, **FLAGGED, **LONG}
_SHORT_S, _LONG_S = 8.0, 14.0  # of the tests' drives


def drive(folder: Path, seed: int, is_long: bool) -> Sequence:
    """Return a drive as those of the tests."""
    settings = SimulationConfig(
        seconds=_LONG_S if is_long else _SHORT_S, seed=seed + is_long, lidar="16-beam", gps=is_long
    )
    return open_sequence(simulate(folder / f"{'long' if is_long else 'short'}-{seed}", settings))


def ride(folder: Path, platform: str, seed: int, is_long: bool) -> Sequence:
    """Return a recording of another platform, named as ``SCENE-LIDAR``."""
    scene, _, lidar = platform.rpartition("-")
    config = PlatformConfig(scene=scene, lidar=lidar, seed=seed, seconds=_LONG_S if is_long else _SHORT_S)
    return open_sequence(simulate_platform(folder / ("long" if is_long else "short"), config))


def recordings(options: argparse.Namespace, is_long: bool) -> Iterator[tuple[str, Sequence]]:
    """Yield each recording with its name."""
    for seed in options.seeds:
        for platform in options.platforms:
            yield f"{platform} {seed}", ride(options.folder, platform, seed, is_long)
        if not options.platforms:
            yield str(seed), drive(options.folder, seed, is_long)


def shown(place: str, name: str, found: Outcome) -> str:
    """Return a line about a run."""
    gross = np.mean(found.nees > GROSS_NEES)
    parts = [f"{found.largest_m:7.2f} m", f"{found.off_share:6.1%} beyond 3 sigma", f"{gross:6.1%} over 25"]
    return f"{place:>22} {name:45} {', '.join(parts)}, {'said' if found.said else 'SILENT'}"


def main() -> None:
    """Run the rows and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=lambda text: [int(seed) for seed in text.split(",")], default=[121, 131])
    parser.add_argument("--rows", type=lambda text: text.split(","), default=[""], metavar="WORDS,…")
    parser.add_argument("--platforms", type=lambda text: text.split(","), default=[], metavar="SCENE-LIDAR,…")
    options = parser.parse_args()
    logging.disable(logging.INFO)
    rows: dict[str, Row] = {k: row for k, row in _ROWS.items() if any(words in k for words in options.rows)}
    pooled: list[Any] = []
    for is_long in (False, True):
        chosen = {name: row for name, row in rows.items() if (name in LONG) == is_long}
        for place, sequence in recordings(options, is_long) if chosen else ():
            for name, row in chosen.items():
                found = run_row(row, sequence)
                print(shown(place, name, found), flush=True)
                pooled += [] if "--no-check" in name else [found.nees]
    nees = np.concatenate(pooled)
    print(f"{len(nees)} positions of {len(pooled)} runs: {np.mean(nees > GROSS_NEES):.2%} with an error over 25")


if __name__ == "__main__":
    main()
