"""What weights of points could gain scan matching, and what registering more points gains; see results.md.

    python benchmarks/point_removal.py [--kinds dust,people,…] [--seeds 8111,8112,8113] [--length-m 100] [--no-bounds]

Each drive is run with the defaults, which register one average a cubic metre, and with all averages of a scan. Both
take each scan in turn, so that their times are comparable. The bounds are runs with the defaults on the same scans

* without the points that lie farther than five standard deviations from what stands along their ray: those of cars,
  people, drops and dust. Weights that tell such points from others gain at most this.
* also without those where the surface is rough: whose neighbours, without noise, lie farther than 3 cm (root mean
  square) from their plane, as leaves, grass and edges do.

What is hidden stays hidden. The noise of a range is alike at all points and independent, so that no network can tell
points by it. Two more rows give planes half their weight at a thickness of 3 cm in place of 15, as is best where
surfaces are clean and poses exact:

* on the smooth points that the truth tells,
* on the points whose measured neighbours, with their noise, lie within 3 cm of a plane: what can be told without truth.

Ratios are geometric means over the drives.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from common import Figures, drift_of, evaluation_of, table_of
from scipy.spatial import cKDTree

from hybridlio.cloud import plane_fitting
from hybridlio.cloud.kd_tree import build_tree
from hybridlio.cloud.plane_loops import principal_axes
from hybridlio.commands.terminal import progress
from hybridlio.core.arrays import Array
from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import Calibration, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.measurements import hits_at
from hybridlio.simulation.plan import plan
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.recording import plan as plan_platform
from hybridlio.simulation.recording import drive_recording
from hybridlio.simulation.scenarios import SCENARIOS, scenario_config
from hybridlio.simulation.sensors.air import CLEAR
from hybridlio.simulation.sensors.lidar import ray_pattern
from hybridlio.sources.settings import ScanMatchingSettings

KINDS = ("heavy-traffic", "parked-lot", "vegetation", "16-beam", "rain", "dust", "people")
PLATFORMS = {"parked-lot": ("garage", 0), "vegetation": ("forest", 0), "people": ("campus", 12)}  # scene and people
SECONDS = 10.0  # of platforms
MOVING_SIGMAS = 5.0
ROUGH_M, NEIGHBOURS = 0.03, 15
THIN_M = 0.03  # thickness at which planes get half their weight
AS_IT_IS, MORE = "as it is", "all averages"
STANDING, SMOOTH, THIN, TOLD = (
    "standing points",
    "standing, smooth",
    "smooth, thin planes",
    "by neighbours, thin planes",
)


class Drive(NamedTuple):
    """A recording, its lidar, the directions ``(R, 3)`` of the rays, and exact ranges ``(R,)`` to what stands."""

    recording: Sequence
    model: LidarModel
    directions: Array
    ranges_m: Callable[[int], Array]


def road(kind: str, seed: int, length_m: float) -> Drive:
    """Return a scenario's drive."""
    config = scenario_config(kind, seed, length_m)
    drive, pattern = plan(config), ray_pattern(config.lidar_model)
    still = replace(drive, cars=[], air=CLEAR)
    recording, model = drive_recording(drive, config), config.lidar_model
    return Drive(recording, model, pattern.directions, lambda k: hits_at(still, k, pattern, config).range_m)


def platform(kind: str, seed: int) -> Drive:
    """Return a walk or ride of a platform with a spinning lidar."""
    scene, people = PLATFORMS[kind]
    walk = plan_platform(PlatformConfig(scene=scene, people=people, seconds=SECONDS, seed=seed))
    alone, scanner, calibration = replace(walk, people=[]), SCANNERS[walk.config.lidar], Calibration(walk.T_imu_lidar)
    recording = Sequence(kind, walk.scan_stamps_ns, walk.scan, walk.imu_samples(), calibration, walk.reference())
    return Drive(recording, scanner.model, scanner.sweep(0.0).directions, lambda k: alone.hits(k).range_m)


def parts(drive: Drive) -> Iterator[tuple[Scan, ...]]:
    """Return of each scan: what stands, of this what is smooth, and what neighbours tell to be smooth."""
    rays = cKDTree(drive.directions)
    for k in range(len(drive.recording)):
        scan = drive.recording.load_scan(k)
        measured_m = np.linalg.norm(scan.points.astype(np.float64), axis=1)
        ray = rays.query(scan.points / measured_m[:, None])[1]
        exact_m = drive.ranges_m(k)[ray]
        standing = np.abs(measured_m - exact_m) <= MOVING_SIGMAS * drive.model.range_sigma_m
        smooth = standing.copy()
        smooth[standing] = roughness_m(drive.directions[ray[standing]] * exact_m[standing, None]) <= ROUGH_M
        told = roughness_m(scan.points.astype(np.float64)) <= ROUGH_M
        yield scan.part(standing), scan.part(smooth), scan.part(told)


def roughness_m(points: Array) -> Array:
    """Return the root mean square distance ``(N,)`` of the neighbours of points ``(N, 3)`` from their plane."""
    neighbours, _ = build_tree(points, 1).batch_knn_search(points, NEIGHBOURS)
    mean_squares, _ = principal_axes(points[neighbours])
    return np.asarray(np.sqrt(np.maximum(mean_squares[:, 0], 0.0)))


def loaded(recording: Sequence, scans: tuple[Scan, ...]) -> Sequence:
    """Return a recording with other scans, which are in memory."""
    return replace(recording, load_scan=lambda k: scans[k])


def in_turn(sequence: Sequence, configs: dict[str, Config]) -> dict[str, Figures]:
    """Return the errors and times of odometries that take each scan of a recording in turn."""
    runs: dict[str, tuple[Odometry, list[Estimate], list[float]]] = {
        name: (Odometry(config=config, keep_record=False), [], []) for name, config in configs.items()
    }
    for frame in sequence:
        for odometry, answers, times_s in runs.values():
            start_s = time.perf_counter()
            answers.append(odometry.step(frame))
            times_s.append(time.perf_counter() - start_s)
    return {name: figures(sequence, answers, times_s) for name, (_, answers, times_s) in runs.items()}


@contextmanager
def thin_planes() -> Iterator[None]:
    """Give planes half their weight at a thickness of 3 cm."""
    before = plane_fitting._HALF_WEIGHT_THICKNESS_M
    plane_fitting._HALF_WEIGHT_THICKNESS_M = THIN_M
    try:
        yield
    finally:
        plane_fitting._HALF_WEIGHT_THICKNESS_M = before


def figures(sequence: Sequence, answers: list[Estimate], times_s: list[float]) -> Figures:
    """Return the errors of a run, and the median time of a scan."""
    poses, covariances = (np.array([getattr(a, name) for a in answers]) for name in ("pose", "covariance"))
    found = evaluation_of(Trajectory(sequence.stamps_ns, poses, covariances), sequence)
    assert found is not None
    errors = {"t_rel [%]": drift_of(found)[0], "ATE [mm]": 1e3 * found.ate_m}
    anees = {"ANEES rotation": found.anees_rotation, "ANEES position": found.anees_position}
    return {**errors, **anees, "time [ms]": 1e3 * float(np.median(times_s))}


def measure(kind: str, seed: int, length_m: float, with_bounds: bool) -> dict[str, Figures]:
    """Return the figures of one drive for each variant."""
    drive = platform(kind, seed) if kind in PLATFORMS else road(kind, seed, length_m)
    scans = tuple(drive.recording.load_scan(k) for k in range(len(drive.recording)))
    recording = loaded(drive.recording, scans)
    more = Config(scan_matching=ScanMatchingSettings(source_voxel_m=ScanMatchingSettings().map_voxel_m))
    found = in_turn(recording, {AS_IT_IS: Config(), MORE: more})
    if not with_bounds:
        return found
    kept = []
    with progress(f"{kind} {seed}") as tick:
        for k, one in enumerate(parts(drive)):
            kept.append(one)
            tick("", k + 1, len(recording))
    standing, smooth, told = zip(*kept, strict=True)
    found |= in_turn(loaded(recording, standing), {STANDING: Config()})
    found |= in_turn(loaded(recording, smooth), {SMOOTH: Config()})
    with thin_planes():
        found |= in_turn(loaded(recording, smooth), {THIN: Config()})
        found |= in_turn(loaded(recording, told), {TOLD: Config()})
    for name, part in ((STANDING, standing), (SMOOTH, smooth), (THIN, smooth), (TOLD, told)):
        found[name]["removed [%]"] = 100 * (1 - sum(map(len, part)) / sum(map(len, scans)))
    return found


def summary(rows: list[dict[str, Figures]]) -> dict[str, Figures]:
    """Return the mean figures of drives for each variant, with ratios to the first one."""
    out = {}
    for variant in rows[0]:
        mean = {name: float(np.mean([row[variant][name] for row in rows])) for name in rows[0][variant]}
        ratios = {
            f"ratio of {name.split()[0]}": float(
                np.exp(np.mean([np.log(r[variant][name] / r[AS_IT_IS][name]) for r in rows]))
            )
            for name in ("t_rel [%]", "ATE [mm]", "time [ms]")
        }
        out[variant] = {**mean, **ratios}
    return out


def table(found: dict[str, list[dict[str, Figures]]]) -> str:
    """Return the table of all kinds, and of all together."""
    everything = {**found, "all": [row for rows in found.values() for row in rows]}
    return table_of(
        {f"{kind}, {name}": row for kind, rows in everything.items() for name, row in summary(rows).items()}
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default=",".join(KINDS), metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--seeds", default="8111,8112,8113", metavar="A,B,…", help="(default: %(default)s)")
    parser.add_argument("--length-m", type=float, default=100.0, help="of each drive on a road (default: %(default)s)")
    parser.add_argument("--no-bounds", action="store_true", help="without the runs on fewer points")
    options = parser.parse_args()
    kinds, known = options.kinds.split(","), (*PLATFORMS, *SCENARIOS)
    if unknown := [kind for kind in kinds if kind not in known]:
        parser.error(f"unknown kind {unknown[0]!r}; choose among {', '.join(known)}")
    found: dict[str, list[dict[str, Figures]]] = {}
    for seed in map(int, options.seeds.split(",")):
        for kind in kinds:
            found.setdefault(kind, []).append(measure(kind, seed, options.length_m, not options.no_bounds))
        print(f"\n{table(found)}", flush=True)


if __name__ == "__main__":
    main()
