"""Matches with a map as factors of a graph, compared with their fusion by covariance intersection.

For each simulated town a second drive is localised in the map of a first one, from a given start. The same steps of the
odometry and the same matches with the map then go into a pose graph: a between-factor a step, with the covariance that
localisation uses, and a prior factor a match, with the match's covariance. Of each scan the pose at its own time is
taken, before later scans are known, as localisation gives it.

* *intersection*: what `hybridlio localize` does.
* *factors*: the matches as independent.
* *factors, N m*: the variances of the matches multiplied by the number of scans in that stretch of the path, so that
  matches that see the same stretch of the map count once.

    python benchmarks/localization_fusion.py --seeds 9811 9821 --length 160 --lidar 16-beam
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from localization import Drive, Place, driven, errors, rms_m

from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.graph import PoseGraph
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.localizer import Localizer, MapPose
from hybridlio.localization.prior_map import PriorMap
from hybridlio.smoothing.loop_closure import up_of
from hybridlio.smoothing.step_uncertainty import drift_of

_START_SIGMAS = np.repeat([1e-3, 0.05], 3)
_STRETCHES_M = (5.0, 20.0)


@dataclass(frozen=True, eq=False)
class At:
    """A pose as :func:`localization.errors` takes it."""

    at: UncertainPose


def followed(maker: Drive, prior: PriorMap, drive: Drive) -> tuple[UncertainPose, dict[int, MapPose]]:
    """Localise a drive from its true start in the map; return the start and the poses by row."""
    true = drive.truth[1]
    near = int(np.linalg.norm(maker.truth[:, :3, 3] - true[:3, 3], axis=1).argmin())
    pose = maker.record.online.poses[near] @ se3.between(maker.truth[near], true)
    start = UncertainPose(pose, np.diag(_START_SIGMAS**2))
    localizer, up, out = Localizer(prior), up_of(drive.record), {}
    localizer.start(start, drive.steps[0][1])
    for k, step in enumerate(drive.steps):
        found = localizer.step(*step, up)
        assert found is not None
        out[k + 1] = found
    return start, out


def by_factors(
    start: UncertainPose, poses: dict[int, MapPose], drive: Drive, scale: float, stretch_m: float
) -> dict[int, At]:
    """Return each scan's pose from a graph that grows; a stretch of zero takes matches as independent."""
    graph, out = PoseGraph(), {}
    solver = graph.online()
    for k, one in poses.items():
        _, pose, step = drive.steps[k - 1]
        moved = np.eye(4) if k == 1 else se3.between(drive.steps[k - 2][1], pose)
        if k == 1:
            graph.add_prior(1, start.pose, covariance=start.covariance)
        else:
            graph.add_between(k - 1, k, moved, covariance=scale * drift_of(step))
        if one.held and one.match is not None:
            scans = max(stretch_m / max(float(np.linalg.norm(moved[:3, 3])), 1e-3), 1.0) if stretch_m else 1.0
            graph.add_prior(k, one.match.found.pose, covariance=scans * one.match.found.covariance)
        solver.update()
        out[k] = At(UncertainPose(solver.pose(k), solver.covariance(k)))
    return out


def row(name: str, maker: Drive, drive: Drive, poses: dict[int, MapPose] | dict[int, At]) -> dict[str, str]:
    """Return a row of the table."""
    here: Array = errors(maker, drive, poses)  # type: ignore[arg-type]
    found = pose_consistency(here, np.array([one.at.covariance for one in poses.values()]))
    figures = {"RMS [cm]": 100 * rms_m(here), "largest [cm]": 100 * np.linalg.norm(here[:, 3:], axis=1).max()}
    anees = {"ANEES position": found.position.value, "rotation": found.rotation.value}
    return {"town, fusion": name} | {key: f"{value:.2f}" for key, value in (figures | anees).items()}


def rows_of(seed: int, maker: Drive, drive: Drive) -> list[dict[str, str]]:
    """Return the rows of one town."""
    prior = maker.map(points_only=False)
    start, poses = followed(maker, prior, drive)
    scale = Localizer(prior).settings.odometry_scale
    out = [row(f"{seed}, intersection", maker, drive, poses)]
    for stretch_m in (0.0, *_STRETCHES_M):
        name = f"{seed}, factors" + (f", {stretch_m:g} m" if stretch_m else "")
        out.append(row(name, maker, drive, by_factors(start, poses, drive, scale, stretch_m)))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[9811, 9821])
    parser.add_argument("--length", type=float, default=160.0)
    parser.add_argument("--lidar", default="16-beam")
    options = parser.parse_args()
    place, rows = Place("town", options.length, options.lidar), []
    for seed in options.seeds:
        rows += rows_of(seed, driven(place, seed), driven(place, seed, seed + 10_000))
    print(tables.to_markdown(rows, words=("town, fusion",)))


if __name__ == "__main__":
    main()
