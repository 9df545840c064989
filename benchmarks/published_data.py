"""Simulate the drives that the ``published`` weights are trained, validated and tested on, as shards.

    python benchmarks/published_data.py DIR [--poses KITTI_POSES] [--drives 150] [--minutes 90]
    python benchmarks/published_data.py DIR --poses KITTI_POSES --test

Each drive is planned, its scans are computed in memory, odometry by scan matching runs over them for the last velocity
of each pair, and they are prepared. Nothing else touches the disk: 45 MB for a drive of 22 s. A shard appears when it
is complete, so that an interrupted run goes on with the next drive.

DIR/training holds seeds 41000 up, DIR/validation seeds 45000 up, DIR/test the seeds of ``TESTS``. Training and
validation drives differ in speed, traffic, parked cars, scene, driver, number of columns, and a little in the
elevations of the beams; with ``--poses`` one in four follows a part of a real path that no test drive follows.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hybridlio.cloud.preparation import prepare
from hybridlio.core.arrays import Array
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.preparing import KnownMotion, prepare_shard
from hybridlio.learned.presets import preset
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import preparation_for
from hybridlio.runs.run import run_odometry
from hybridlio.simulation import SimulationConfig
from hybridlio.simulation.recording import simulated_recording

Planned = tuple[SimulationConfig, LidarModel]

TRAINING_SEED, VALIDATION_SEED = 41000, 45000
VALIDATION_DRIVES = 10
SECONDS = 22.0
COLUMNS = (750, 937, 1250)  # a fraction of the HDL-64E's 1875: the reduced maps have 360 columns
PATHS = ("00", "02", "03", "05", "07", "08")  # 01 and 06 are test drives
TESTS = {
    3006: {"poses": "06"},
    3011: {"poses": "01"},
    3021: {"speed_m_s": 12.0, "length_m": 1200.0},
    3022: {"speed_m_s": 22.0, "length_m": 1200.0, "traffic_per_km": 30.0},
}
UNSURE_STEP_M = 0.05  # as in runs/training_data.py: a step that scans determine less well gives no velocity


def lidar_of(rng: np.random.Generator) -> LidarModel:
    """Return an HDL-64E whose beams lie a little elsewhere, with fewer columns."""
    model = LIDAR_MODELS["hdl-64e"]
    scale, shift_deg = 1 + 0.02 * rng.normal(), 0.2 * rng.normal()
    elevations = scale * np.array(model.elevations_deg) + shift_deg + 0.04 * rng.normal(size=model.beams)
    return replace(model, elevations_deg=tuple(np.sort(elevations)[::-1].tolist()), columns=int(rng.choice(COLUMNS)))


def drive_of(seed: int, poses: Path | None, folder: Path) -> Planned:
    """Draw the settings of a drive from its seed; one in four goes along a part of a real path, where given."""
    rng = np.random.default_rng([seed, 1])
    lidar = lidar_of(rng)
    traffic, parked = float(rng.uniform(0, 60)), float(rng.uniform(0, 0.9))
    along, path, start = rng.random() < 0.25, str(rng.choice(PATHS)), rng.random()
    common = {"seed": seed, "seconds": SECONDS, "traffic_per_km": traffic, "parked": parked}
    if along and poses is not None:
        rows = (poses / f"{path}.txt").read_text(encoding="utf-8").splitlines(keepends=True)
        first = int(start * max(len(rows) - 10 * SECONDS - 10, 0))
        part = folder / f"{seed}.txt"
        part.write_text("".join(rows[first : first + int(10 * SECONDS) + 10]), encoding="utf-8")
        return SimulationConfig(**common, poses=part), lidar
    config = SimulationConfig(
        **common,
        speed_m_s=float(rng.uniform(2, 33)),
        driving="hard" if rng.random() < 0.3 else "calm",
        scene=str(rng.choice(["town", "field", "corridor"], p=[0.85, 0.12, 0.03])),  # type: ignore[arg-type]
        start_moving=bool(rng.random() < 0.8),
        loops=bool(rng.random() < 0.15),
    )
    return config, lidar


def in_memory(sequence: Sequence) -> Sequence:
    """Return the recording with each scan computed once."""
    scans: dict[int, Scan] = {}

    def load(k: int) -> Scan:
        if k not in scans:
            scans[k] = sequence.load_scan(k)
        return scans[k]

    return replace(sequence, load_scan=load)


def odometry_steps(sequence: Sequence) -> dict[int, Array]:
    """Return the steps ``T_k_k1`` by the scan that they lead to, where scans determine them."""
    run = run_odometry(sequence, Odometry(config=Config(initial_pose="preintegration", residual="scan-matching")))
    if run.stopped is not None:
        raise run.stopped
    known = [e for e in run.estimates if e.step is not None and e.relative is not None and e.relative.ok]
    return {
        e.index: e.step.pose
        for e in known
        if e.step is not None and e.relative is not None and e.relative.translation_sigma_m <= UNSURE_STEP_M
    }


def test_drive(seed: int, poses: Path) -> Planned:
    """Return the settings of a test drive, of 1 km and more, with every column of the HDL-64E."""
    settings = dict(TESTS[seed])
    if "poses" in settings:
        settings["poses"] = poses / f"{settings['poses']}.txt"
    return SimulationConfig(seed=seed, **settings), LIDAR_MODELS["hdl-64e"]


def write(place: Path, plan: Callable[[Path], Planned]) -> None:
    """Write the shard of a drive."""
    recipe, start = preset("published"), time.monotonic()
    options = replace(preparation_for(recipe), threads=1)
    with tempfile.TemporaryDirectory() as scratch:
        config, lidar = plan(Path(scratch))
        sequence = in_memory(simulated_recording(config, lidar))
        steps = odometry_steps(sequence)
        between = time.monotonic()
        motion = KnownMotion(
            step=lambda frame: steps.get(frame.index),
            source=f"benchmarks/published_data.py, {config.model_dump_json()}",
        )
        prepare_shard(sequence, place, partial(prepare, options=options), recipe.network, motion)
    done = time.monotonic()
    print(
        f"{config.seed}: {len(sequence)} scans, {len(steps)} steps, {config.scene}, {config.speed_m_s:.0f} m/s, "
        f"{between - start:.0f} + {done - between:.0f} s",
        flush=True,
    )


def simulate(folder: Path, seeds: list[int], poses: Path | None, ends: float) -> None:
    """Write the shards of drives that are not there yet, until a time of ``time.monotonic``."""
    for seed in seeds:
        place = folder / f"{seed}"
        if time.monotonic() < ends and not (place / "shard.json").is_file():
            write(place, partial(drive_of, seed, poses))


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
        place = options.folder / "test" / f"{seed}"
        if not (place / "shard.json").is_file():
            write(place, lambda _, seed=seed: test_drive(seed, options.poses))


if __name__ == "__main__":
    main()
