"""Localisation in maps of simulated towns: accuracy, covariance, starts from nowhere, and belief in other towns.

For each seed, a first drive makes a map by its odometry, and a second one through the same town, with other traffic,
other parked cars and another driver, is localised in it. Errors are those of the pose relative to the nearest pose of
the first drive (*here*), which do not contain the drift of the map, and of the pose relative to the first drive's first
pose (*whole map*), which do.

Starts are spread evenly over the second drives; the localisation begins there without any knowledge and has 10 s. Every
second drive is also given to the maps of the other towns, where it must find nothing.

    python benchmarks/localization.py --seeds 9801 9802 9803
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Scan
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.localization.localizer import Localizer, MapPose
from hybridlio.localization.open_map import map_of_record
from hybridlio.localization.prior_map import PriorMap
from hybridlio.record.record import Record
from hybridlio.simulation.measurements import lidar_poses
from hybridlio.simulation.plan import plan
from hybridlio.simulation.recording import drive_recording
from hybridlio.smoothing.loop_closure import up_of

_FALSE_M = 0.5  # a pose this far off, while the map holds it, is a false belief
_START_S = 10.0
_RATE_HZ = 10


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive after odometry.

    Attributes:
        record: of the odometry.
        truth: ``(N, 4, 4)`` ``T_town_lidar``.
        steps: scan, odometry's pose and step of every scan after the first.
        ms: odometry's mean time a scan.
    """

    record: Record
    truth: np.ndarray
    steps: list[tuple[Scan, np.ndarray, RelativePose]]
    ms: float


def driven(seed: int, drive_seed: int | None, length_m: float) -> Drive:
    config = hl.SimulationConfig(seed=seed, drive_seed=drive_seed, length_m=length_m, motion_distortion=True)
    planned, odometry, steps = plan(config), hl.Odometry(), []
    spent = 0.0
    for frame in drive_recording(planned, config):
        began = time.process_time()
        estimate = odometry.step(frame)
        spent += time.process_time() - began
        if odometry.last_scan is not None and estimate.relative is not None:
            steps.append((odometry.last_scan, estimate.pose, estimate.relative))
    return Drive(odometry.record(), lidar_poses(planned), steps, 1e3 * spent / max(len(steps), 1))


def follow(prior: PriorMap, drive: Drive, first: int, scans: int | None, stop: bool) -> dict[int, MapPose]:
    """Localise scans of a drive from one on; return the poses by row. ``stop`` ends at the first pose."""
    localizer, up, out = Localizer(prior), up_of(drive.record), {}
    last = len(drive.steps) if scans is None else min(first + scans, len(drive.steps))
    for k in range(first, last):
        found = localizer.step(*drive.steps[k], up)
        if found is not None:
            out[k + 1] = found
            if stop:
                break
    return out


def errors(maker: Drive, drive: Drive, poses: dict[int, MapPose], whole: bool) -> np.ndarray:
    """Return the errors ``(N, 6)`` of poses in the map, relative to its nearest pose, or to its first."""
    out = []
    own = maker.record.online.poses
    for k, one in poses.items():
        true = drive.truth[k]
        near = 0 if whole else int(np.linalg.norm(maker.truth[:, :3, 3] - true[:3, 3], axis=1).argmin())
        out.append(se3.log(se3.between(one.at.pose, own[near] @ se3.between(maker.truth[near], true))))
    return np.array(out).reshape(-1, 6)


def rms_m(found: np.ndarray) -> float:
    return float(np.sqrt((found[:, 3:] ** 2).sum(axis=1).mean()))


def accuracy(seed: int, maker: Drive, prior: PriorMap, drive: Drive) -> None:
    began = time.process_time()
    poses = follow(prior, drive, 0, None, stop=False)
    ms = 1e3 * (time.process_time() - began) / len(drive.steps)
    here, whole = (errors(maker, drive, poses, whole) for whole in (False, True))
    held = np.array([one.held for one in poses.values()])
    found = pose_consistency(here, np.array([one.at.covariance for one in poses.values()]))
    largest = np.linalg.norm(here[:, 3:], axis=1).max()
    print(
        f"{seed}: {len(poses)} scans, {held.mean():.1%} held, RMS here {100 * rms_m(here):.2f} cm "
        f"(largest {100 * largest:.2f}), whole map {100 * rms_m(whole):.2f} cm, ANEES position "
        f"{found.position.value:.2f}, rotation {found.rotation.value:.2f}; odometry {drive.ms:.0f} ms a scan, "
        f"localisation {ms:.0f} ms more",
        flush=True,
    )


def starts(maker: Drive, prior: PriorMap, drive: Drive, count: int) -> list[tuple[float, float]]:
    """Return for each start the seconds until it is found, infinite if it is not, and the error there in metres."""
    out = []
    scans = round(_START_S * _RATE_HZ)
    for first in np.linspace(0, len(drive.steps) - scans, count).astype(int):
        poses = follow(prior, drive, int(first), scans, stop=True)
        if not poses:
            out.append((np.inf, 0.0))
            continue
        found = errors(maker, drive, poses, whole=False)
        out.append(((next(iter(poses)) - first) / _RATE_HZ, float(np.linalg.norm(found[0, 3:]))))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[9801, 9802, 9803], help="of towns")
    parser.add_argument("--length-m", type=float, default=250.0, help="of each drive (default: %(default)s)")
    parser.add_argument("--starts", type=int, default=50, help="starts in all (default: %(default)s)")
    options = parser.parse_args()
    found: list[tuple[float, float]] = []
    towns = []
    for seed in options.seeds:
        maker, drive = driven(seed, None, options.length_m), driven(seed, seed + 10_000, options.length_m)
        prior = map_of_record(maker.record)
        accuracy(seed, maker, prior, drive)
        found += starts(maker, prior, drive, -(-options.starts // len(options.seeds)))
        towns.append((seed, prior, drive))
    seconds, off = np.array(found).T
    in_time = np.isfinite(seconds)
    print(
        f"{len(found)} starts: {in_time.mean():.0%} found within {_START_S:.0f} s, median "
        f"{np.median(seconds):.1f} s, 95 % within {np.quantile(seconds, 0.95):.1f} s; {(off > _FALSE_M).sum()} false"
    )
    others = [(a, b, follow(prior, drive, 0, None, stop=True)) for a, prior, _ in towns for b, _, drive in towns]
    false = [f"{b} in {a}" for a, b, poses in others if a != b and poses]
    print(f"{sum(a != b for a, b, _ in others)} drives in maps of other towns: {len(false)} believed {false or ''}")


if __name__ == "__main__":
    main()
