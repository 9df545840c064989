"""Simulate the drives that the ``published`` weights are trained, validated and tested on, as shards.

    python benchmarks/published_data.py DIR [--poses KITTI_POSES] [--drives 150] [--minutes 90]
    python benchmarks/published_data.py DIR --poses KITTI_POSES --test

Scans are computed in memory; only the shards touch the disk, 45 MB for a drive of 22 s. A shard appears when it is
complete, so that an interrupted run goes on with the next drive. ``hybridlio train --simulate N`` does the same without
real paths.

DIR/training holds the shards of seeds 41000 up, DIR/validation those of 45000 up, DIR/test those of ``TESTS``. How
training and validation drives differ: :func:`hybridlio.simulation.training_drives.training_drive`. With ``--poses`` one
in four follows a part of a real path that no test drive follows.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.learned.presets import preset
from hybridlio.runs.training.simulated_data import DRIVE_S, TRAINING_SEED, VALIDATION_SEED, prepare_drives
from hybridlio.runs.training.training_data import DataOptions
from hybridlio.simulation import SimulationConfig
from hybridlio.simulation.training_drives import training_drive

Planned = tuple[SimulationConfig, LidarModel]

VALIDATION_DRIVES = 10
PATHS = ("00", "02", "03", "05", "07", "08")  # 01 and 06 are test drives
TESTS: dict[int, dict[str, Any]] = {
    3006: {"poses": "06"},
    3011: {"poses": "01"},
    3021: {"speed_m_s": 12.0, "length_m": 1200.0},
    3022: {"speed_m_s": 22.0, "length_m": 1200.0, "traffic_per_km": 30.0},
}


def drive_of(seed: int, poses: Path | None, folder: Path) -> Planned:
    """Draw a drive from its seed; one in four goes along a part of a real path, where given."""
    config, lidar = training_drive(seed, DRIVE_S)
    rng = np.random.default_rng([seed, 2])
    if poses is None or rng.random() >= 0.25:
        return config, lidar
    rows = (poses / f"{rng.choice(PATHS)}.txt").read_text(encoding="utf-8").splitlines(keepends=True)
    count = int(10 * DRIVE_S) + 10
    first = int(rng.random() * max(len(rows) - count, 0))
    part = folder / f"{seed}.txt"
    part.write_text("".join(rows[first : first + count]), encoding="utf-8")
    return SimulationConfig(
        **config.model_dump(include={"seed", "seconds", "traffic_per_km", "parked"}), poses=part
    ), lidar


def _planned_test(seed: int, poses: Path, _: Path) -> Planned:
    return test_drive(seed, poses)


def test_drive(seed: int, poses: Path) -> Planned:
    """Return the settings of a test drive, of 1 km and more, with every column of the HDL-64E."""
    settings = dict(TESTS[seed])
    if "poses" in settings:
        settings["poses"] = poses / f"{settings['poses']}.txt"
    return SimulationConfig(seed=seed, **settings), LIDAR_MODELS["hdl-64e"]


def write(cache: Path, plan: Callable[[Path], Planned]) -> None:
    """Write the shard of a drive, unless it is there."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        drive = plan(Path(scratch))
        (shard,) = prepare_drives([drive], preset("published"), DataOptions(cache))
    print(f"{shard.info.name}: {len(shard)} scans, {drive[0].scene}, {time.monotonic() - start:.0f} s", flush=True)


def simulate(folder: Path, seeds: list[int], poses: Path | None, ends: float) -> None:
    """Write the shards of drives, until a time of ``time.monotonic``."""
    for seed in seeds:
        if time.monotonic() < ends:
            write(folder, partial(drive_of, seed, poses))


def simulate_all(folder: Path, drives: int, poses: Path | None, minutes: float) -> None:
    """Write all shards; a few of either kind first, so that a network can be tried soon."""
    validation = [VALIDATION_SEED + k for k in range(VALIDATION_DRIVES)]
    training = [TRAINING_SEED + k for k in range(drives)]
    ends = time.monotonic() + 60 * minutes
    parts = (
        ("training", training[:6]),
        ("validation", validation[:3]),
        ("training", training[:40]),
        ("validation", validation),
        ("training", training),
    )
    for part, seeds in parts:
        simulate(folder / part, seeds, poses, ends)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--poses", type=Path, help="folder of KITTI pose files to drive along")
    parser.add_argument("--drives", type=int, default=150)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--test", action="store_true", help="the test drives, which need --poses")
    options = parser.parse_args()
    if not options.test:
        simulate_all(options.folder, options.drives, options.poses, options.minutes)
        return
    if options.poses is None:
        parser.error("--test needs --poses: two test drives follow real paths")
    for seed in TESTS:
        write(options.folder / "test", partial(_planned_test, seed, options.poses))


if __name__ == "__main__":
    main()
