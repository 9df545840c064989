"""How much scan matching could gain if it knew which points belong to nothing that stands; see benchmarks/README.md.

    python benchmarks/point_removal.py [--kinds heavy-traffic,rain,dust,people] [--seeds 8101,8102] [--length-m 150]

Each drive is run twice with the defaults: on the scans as they are, and without the points that the simulator knows to
be of moving cars, people, drops or dust. What these hide stays hidden. The second is what no weights of points can
exceed by telling such points from others.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from common import Figures, drift_of, evaluation_of, table_of

from hybridlio.commands.terminal import progress
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.measurements import hits_at, measured_scan
from hybridlio.simulation.plan import plan
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.recording import plan as plan_platform
from hybridlio.simulation.recording import drive_recording
from hybridlio.simulation.scenarios import SCENARIOS, scenario_config
from hybridlio.simulation.sensors.air import CLEAR
from hybridlio.simulation.sensors.lidar import ray_pattern
from hybridlio.simulation.world.rays import Hits

PEOPLE = 12  # around a handheld lidar on a campus
SECONDS = 15.0

Both = Callable[[int], tuple[Scan, Scan]]
"""Returns scan ``k`` as it is, and without points of what moves."""


def road(kind: str, seed: int, length_m: float) -> tuple[Sequence, Both]:
    """Return a scenario's recording, and its scans with and without points of what moves."""
    config = scenario_config(kind, seed, length_m)
    drive = plan(config)
    still, pattern = replace(drive, cars=[], air=CLEAR), ray_pattern(config.lidar_model)

    def both(k: int) -> tuple[Scan, Scan]:
        seen, bare = hits_at(drive, k, pattern, config), hits_at(still, k, pattern, config)
        rest = standing(seen, bare)
        return measured_scan(seen, drive, k, pattern, config), measured_scan(rest, drive, k, pattern, config)

    return drive_recording(drive, config), both


def among_people(seed: int) -> tuple[Sequence, Both]:
    """Return a recording of a walk among people on a campus, and its scans with and without their points."""
    walk = plan_platform(PlatformConfig(scene="campus", people=PEOPLE, seconds=SECONDS, seed=seed))
    alone = replace(walk, people=[])

    def both(k: int) -> tuple[Scan, Scan]:
        seen, bare = walk.hits(k), alone.hits(k)
        return walk.measured(k, seen), walk.measured(k, standing(seen, bare))

    imu: ImuSamples = walk.imu_samples()
    recording = Sequence(
        f"people-{seed}", walk.scan_stamps_ns, walk.scan, imu, Calibration(walk.T_imu_lidar), walk.reference()
    )
    return recording, both


def standing(seen: Hits, bare: Hits) -> Hits:
    """Return the hits without those of rays that would go farther if nothing moved and the air were clear."""
    ranges_m = np.where(seen.range_m == bare.range_m, seen.range_m, np.inf)
    return Hits(ranges_m, seen.cosine, seen.reflectance)


def figures(sequence: Sequence, scans: list[Scan]) -> Figures:
    """Return the drift of the defaults on these scans of a recording."""
    odometry = Odometry(keep_record=False)
    given = replace(sequence, load_scan=lambda k: scans[k])
    answers = [odometry.step(frame) for frame in given]
    poses, covariances = (np.array([getattr(a, name) for a in answers]) for name in ("pose", "covariance"))
    found = evaluation_of(Trajectory(sequence.stamps_ns, poses, covariances), sequence)
    if found is None:
        return {"t_rel [%]": None}
    names = {"ATE [mm]": 1e3 * found.ate_m, "ANEES rotation": found.anees_rotation}
    return {"t_rel [%]": drift_of(found)[0]} | names | {"ANEES position": found.anees_position}


def measure(kind: str, seed: int, length_m: float) -> dict[str, Figures]:
    """Return the rows of one drive."""
    sequence, both = among_people(seed) if kind == "people" else road(kind, seed, length_m)
    with progress(f"{kind} {seed}") as tick:
        pairs = []
        for k in range(len(sequence)):
            pairs.append(both(k))
            tick("", k + 1, len(sequence))
    seen, bare = ([pair[i] for pair in pairs] for i in (0, 1))
    share = 1 - sum(map(len, bare)) / sum(map(len, seen))
    name = f"{kind} {seed}"
    return {
        name: {"removed [%]": 0.0, **figures(sequence, seen)},
        f"{name}, without": {"removed [%]": 100 * share, **figures(sequence, bare)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="heavy-traffic,rain,dust,people", metavar="A,B,…", help="(default: all)")
    parser.add_argument("--seeds", default="8101,8102", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--length-m", type=float, default=150.0, help="of each drive (default: %(default)s)")
    options = parser.parse_args()
    kinds = options.kinds.split(",")
    if unknown := [kind for kind in kinds if kind != "people" and kind not in SCENARIOS]:
        parser.error(f"unknown kind {unknown[0]!r}; choose among people, {', '.join(SCENARIOS)}")
    rows: dict[str, Figures] = {}
    for seed in map(int, options.seeds.split(",")):
        for kind in kinds:
            rows |= measure(kind, seed, options.length_m)
            print(f"\n{table_of(rows)}", flush=True)


if __name__ == "__main__":
    main()
