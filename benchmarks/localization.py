"""Localisation in maps of simulated places: accuracy, covariance, starts from nowhere, and belief where it is wrong.

For each seed, a first drive makes a map by its odometry (``--maps``: its run folder's; *points*, those of the map file
that it makes, without places; or both), and a second one through the same place, with other traffic,
other parked cars and another driver (``--scene office``: another walk), is localised in it. Errors are those of the
pose relative to the nearest pose of the first drive (*here*), which do not contain the drift of the map, and of the
pose relative to the first drive's first pose (*whole map*), which do.

* *Starts inside* are spread evenly over the second drives; the localisation begins there without any knowledge and has
  10 s, or what is left of the drive, 5 s at least.
* *Starts outside* are those of the second drive farther than 50 m (in rooms 10 m) from every pose of a map that ends
  after a part of the first drive (``--map-share``). What is believed there is right only within 0.5 m (``--false-m``).
* Every second drive is also given to the maps of the other places, where it must find nothing.

    python benchmarks/localization.py --seeds 9801 9802 9803
    python benchmarks/localization.py --maps points --scene office --lidar os0 --length 40
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.localization.localizer import Localizer, MapPose
from hybridlio.localization.open_map import map_of_record
from hybridlio.localization.prior_map import PriorMap
from hybridlio.record.record import Record
from hybridlio.simulation import plan as town_plans
from hybridlio.simulation.measurements import lidar_poses
from hybridlio.simulation.platforms import recording as platform_plans
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.recording import drive_recording
from hybridlio.smoothing.loop_closure import up_of

_START_S, _LEAST_S = 10.0, 5.0
_RATE_HZ = 10
WHERE = ("inside", "outside")
_OUTSIDE_M = {"town": 50.0, "office": 10.0}  # a lidar there sees little of what the map holds


@dataclass(frozen=True)
class Place:
    """What is simulated: a scene, the length of a drive [m] or of a walk [s], and the lidar."""

    scene: str
    length: float
    lidar: str

    def recording(self, seed: int, drive_seed: int | None) -> tuple[Sequence, Array]:
        """Return a drive, with the exact lidar poses ``(N, 4, 4)`` in the frame of the place."""
        if self.scene != "town":
            walk = platform_plans.plan(
                PlatformConfig(
                    scene=self.scene, lidar=self.lidar, seconds=self.length, seed=seed, drive_seed=drive_seed
                )
            )
            calibration, imu = Calibration(T_imu_lidar=walk.T_imu_lidar), walk.imu_samples()
            sequence = Sequence(f"walk-{seed}", walk.scan_stamps_ns, walk.scan, imu, calibration, walk.reference())
            return sequence, walk.lidar_poses(walk.scan_times_s)
        config = hl.SimulationConfig(
            seed=seed, drive_seed=drive_seed, length_m=self.length, motion_distortion=True, lidar=self.lidar
        )
        planned = town_plans.plan(config)
        return drive_recording(planned, config), lidar_poses(planned)


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive after odometry.

    Attributes:
        record: of the odometry.
        truth: ``(N, 4, 4)`` lidar poses in the frame of the place.
        steps: scan, odometry's pose and step of every scan after the first.
        ms: odometry's mean time a scan.
        sequence: the recording, its scans in memory where they are needed again.
    """

    record: Record
    truth: Array
    steps: list[tuple[Scan, Array, RelativePose]]
    ms: float
    sequence: Sequence

    def map(self, points_only: bool, share: float = 1.0) -> PriorMap:
        """Return the map of the first share of the drive: the run's, or its points without its places."""
        rows = round(share * len(self.record.online))
        online = self.record.online
        if points_only:
            part = Trajectory(online.stamps_ns[:rows], online.poses[:rows])
            return PriorMap.of(hl.build_map(self.sequence, part).points)
        keyframes = self.record.keyframes
        assert keyframes is not None
        return map_of_record(replace(self.record, keyframes=keyframes.until(rows)))


def driven(place: Place, seed: int, drive_seed: int | None = None) -> Drive:
    """Simulate a drive and run the odometry."""
    (whole, truth), odometry, steps = place.recording(seed, drive_seed), hl.Odometry(), []
    scans = {k: whole.load_scan(k) for k in range(len(whole))}
    sequence = replace(whole, load_scan=scans.__getitem__)
    spent = 0.0
    for frame in sequence:
        began = time.process_time()
        estimate = odometry.step(frame)
        spent += time.process_time() - began
        if odometry.last_scan is not None and estimate.relative is not None:
            steps.append((odometry.last_scan, estimate.pose, estimate.relative))
    return Drive(odometry.record(), truth, steps, 1e3 * spent / max(len(steps), 1), sequence)


def follow(localizer: Localizer, drive: Drive, first: int = 0, stop: bool = True) -> dict[int, MapPose]:
    """Localise the scans of a drive from one on; return the poses by row. ``stop`` ends at the first pose, or 10 s."""
    localizer.forget()
    up, out = up_of(drive.record), {}
    last = first + round(_START_S * _RATE_HZ) if stop else len(drive.steps)
    for k in range(first, min(last, len(drive.steps))):
        found = localizer.step(*drive.steps[k], up)
        if found is not None:
            out[k + 1] = found
            if stop:
                break
    return out


def errors(maker: Drive, drive: Drive, poses: dict[int, MapPose], whole: bool = False) -> Array:
    """Return the errors ``(N, 6)`` of poses in the map, relative to its nearest pose, or to its first."""
    out = []
    own = maker.record.online.poses
    for k, one in poses.items():
        true = drive.truth[k]
        near = 0 if whole else int(np.linalg.norm(maker.truth[:, :3, 3] - true[:3, 3], axis=1).argmin())
        out.append(se3.log(se3.between(one.at.pose, own[near] @ se3.between(maker.truth[near], true))))
    return np.array(out).reshape(-1, 6)


def rms_m(found: Array) -> float:
    """Return the root mean square of the positions of errors ``(N, 6)``."""
    return float(np.sqrt((found[:, 3:] ** 2).sum(axis=1).mean()))


def accuracy(name: str, maker: Drive, prior: PriorMap, drive: Drive) -> None:
    """Print how well a whole drive is followed from nowhere on."""
    began = time.process_time()
    poses = follow(Localizer(prior), drive, stop=False)
    if not poses:
        print(f"{name}: not found", flush=True)
        return
    ms = 1e3 * (time.process_time() - began) / len(drive.steps)
    here, whole = (errors(maker, drive, poses, whole) for whole in (False, True))
    held = np.array([one.held for one in poses.values()])
    found = pose_consistency(here, np.array([one.at.covariance for one in poses.values()]))
    largest = np.linalg.norm(here[:, 3:], axis=1).max()
    print(
        f"{name}: {len(poses)} scans, {held.mean():.1%} held, RMS here {100 * rms_m(here):.2f} cm "
        f"(largest {100 * largest:.2f}), whole map {100 * rms_m(whole):.2f} cm, ANEES position "
        f"{found.position.value:.2f}, rotation {found.rotation.value:.2f}; odometry {drive.ms:.0f} ms a scan, "
        f"localisation {ms:.0f} ms more",
        flush=True,
    )


def starts(maker: Drive, prior: PriorMap, drive: Drive, rows: list[int]) -> list[tuple[float, float]]:
    """Return for each start the seconds until it is found, infinite if it is not, and the error there in metres."""
    out, localizer = [], Localizer(prior)
    for first in rows:
        poses = follow(localizer, drive, first)
        if not poses:
            out.append((np.inf, 0.0))
            continue
        off = errors(maker, drive, poses)[0, 3:]
        out.append(((next(iter(poses)) - first) / _RATE_HZ, float(np.linalg.norm(off))))
    return out


def inside(drive: Drive, count: int) -> list[int]:
    """Return the rows of starts that leave 10 s of the drive."""
    return [int(k) for k in np.linspace(0, max(len(drive.steps) - round(_LEAST_S * _RATE_HZ), 0), count)]


def outside(maker: Drive, share: float, drive: Drive, count: int, least_m: float) -> list[int]:
    """Return the rows of starts that stay away from the map of a share of the first drive."""
    made = maker.truth[: round(share * len(maker.truth)), :3, 3]
    away = [k for k, T in enumerate(drive.truth[1:]) if np.linalg.norm(made - T[:3, 3], axis=1).min() > least_m]
    return [away[int(k)] for k in np.linspace(0, 0.7 * (len(away) - 1), count)] if away else []


def say(name: str, found: list[tuple[float, float]], false_m: float) -> None:
    """Print what was found of starts."""
    seconds, off = np.array(found).reshape(-1, 2).T
    times = "" if np.isinf(seconds).all() else f", median {np.median(seconds):.1f} s"
    worst = f", the worst by {off.max():.2f} m" if len(off) else ""
    print(
        f"{name}: {len(found)} starts, {np.isfinite(seconds).sum()} found within {_START_S:.0f} s{times}, "
        f"{(off > false_m).sum()} false{worst}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[9801, 9802, 9803], help="of places")
    parser.add_argument("--scene", default="town", choices=list(_OUTSIDE_M))
    parser.add_argument("--length", type=float, default=250.0, help="of a drive in metres, of a walk in seconds")
    parser.add_argument("--starts", type=int, default=50, help="inside (default: %(default)s)")
    parser.add_argument("--outside", type=int, default=20, help="starts outside (default: %(default)s)")
    parser.add_argument("--lidar", default="hdl-64e")
    parser.add_argument("--maps", nargs="+", choices=["run", "points"], default=["run", "points"])
    parser.add_argument("--map-share", type=float, default=0.4, help="of the first drive, for starts outside")
    parser.add_argument("--false-m", type=float, default=0.5, help="what is believed and farther off is false")
    options = parser.parse_args()
    place = Place(options.scene, options.length, options.lidar)
    within, without = (-(-count // len(options.seeds)) for count in (options.starts, options.outside))
    found: dict[str, list[tuple[float, float]]] = {f"{kind}, {where}": [] for kind in options.maps for where in WHERE}
    made = []
    for seed in options.seeds:
        maker, drive = driven(place, seed), driven(place, seed, seed + 10_000)
        rows = inside(drive, within), outside(maker, options.map_share, drive, without, _OUTSIDE_M[options.scene])
        for kind in options.maps:
            prior, part = (maker.map(kind == "points", share) for share in (1.0, options.map_share))
            accuracy(f"{seed}, {kind}", maker, prior, drive)
            for where, known, at in zip(WHERE, (prior, part), rows, strict=True):
                found[f"{kind}, {where}"] += starts(maker, known, drive, at)
                say(f"{kind}, {where}", found[f"{kind}, {where}"], options.false_m)
            made.append((kind, seed, prior, drive))
    elsewhere(made)


def elsewhere(made: list[tuple[str, int, PriorMap, Drive]]) -> None:
    """Print what drives believe in the maps of other places, from three starts each."""
    believed, count = [], 0
    for kind, seed, prior, _ in made:
        localizer = Localizer(prior)
        for _, other, _, drive in (one for one in made if one[0] == kind and one[1] != seed):
            rows = inside(drive, 3)
            believed += [(kind, seed, other, k) for k in rows if follow(localizer, drive, k)]
            count += len(rows)
    print(f"{count} starts in maps of other places: {len(believed)} believed {believed or ''}")


if __name__ == "__main__":
    main()
