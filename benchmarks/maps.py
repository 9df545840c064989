"""Measure maps of simulated drives: distance to the true surfaces, moving objects left, and time.

    python benchmarks/maps.py [--seeds 9401 9402] [--length-m 200] [--traffic 30] [--lidar hdl-64e]

For each drive the map by the true poses, which bounds what a map can be, and the maps by the poses that hybridlio
estimates online and smooths. Root mean squares of the distances to the true surfaces, the map placed in four ways:

* *path*: by the rigid motion of its trajectory onto the true one, over all poses, as ATE is defined. Odometry does not
  observe where its world lies, so this motion is a convention, not an error; the drift of the path counts in full.
* *poses*: likewise, but each pose's rotation weighs as the displacement of its points, whose root mean square distance
  from the path is the lever. Positions along a straight street alone leave the rotation about it open.
* *ICP*: by the rigid motion of the map onto the true surfaces, as people compare clouds in CloudCompare.
* *first scan*: by the pose of the first scan alone. Its single measurement, 0.01 to 0.05° from the true surfaces like
  that of any scan, turns the whole map about it.

Each is also given over that of the map by true poses. *Ghosts* are points farther than 0.3 m from everything that
stands still: what moving cars left behind.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.spatial import cKDTree

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.ate_rpe import LEVER_M, align
from hybridlio.mapping.build import build_map
from hybridlio.mapping.settings import MapSettings
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.measurements import lidar_poses
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.recording import drive_recording
from hybridlio.simulation.world.shapes import merge
from hybridlio.simulation.world.world import TILE_M

GHOST_M = 0.3  # three voxels, and over ten times a range's noise
ICP_POINTS, ICP_ROUNDS = 200_000, 20  # the motion is then known to well below a millimetre


class Surfaces:
    """What stands still in a simulated world around a map, in the frame of the first scan."""

    def __init__(self, drive: Drive, points: Array) -> None:
        import open3d as o3d

        self._tensor = cast("Any", o3d.core.Tensor)  # its stubs know no arrays
        self._T_world_first = lidar_poses(drive)[0]
        at = se3.transform(self._T_world_first, points)
        low, high = (np.floor((f(at[:, :2], axis=0)) / TILE_M).astype(int) for f in (np.min, np.max))
        tiles = [(i, j) for i in range(low[0] - 1, high[0] + 2) for j in range(low[1] - 1, high[1] + 2)]
        mesh = merge([drive.world.tile_mesh(tile) for tile in tiles])
        self._origin = at.mean(axis=0)
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = (mesh.vertices - self._origin).astype(np.float32)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(mesh.triangles.astype(np.uint32)))

    def distances(self, points: Array) -> Array:
        """Return the distance ``(N,)`` of points ``(N, 3)``."""
        return np.asarray(self._scene.compute_distance(self._local(points)).numpy().astype(np.float64))

    def alignment(self, points: Array) -> Array:
        """Return the rigid motion ``(4, 4)`` of points ``(N, 3)`` onto the surfaces, by point-to-plane ICP."""
        chosen = points[np.random.default_rng(0).permutation(len(points))[:ICP_POINTS]]
        motion = np.eye(4)
        for _ in range(ICP_ROUNDS):
            moved = se3.transform(motion, chosen)
            nearest: dict[str, Any] = self._scene.compute_closest_points(self._local(moved))
            normals = nearest["primitive_normals"].numpy().astype(np.float64) @ self._T_world_first[:3, :3]
            on_surface = nearest["points"].numpy().astype(np.float64) + self._origin
            offset = moved - se3.transform(se3.inverse(self._T_world_first), on_surface)
            near = np.linalg.norm(offset, axis=1) < GHOST_M
            residual = np.einsum("ij,ij->i", normals, offset)[near]
            rows = np.hstack([np.cross(moved[near], normals[near]), normals[near]])
            motion = se3.exp(-np.linalg.lstsq(rows, residual, rcond=None)[0]) @ motion
        return motion

    def _local(self, points: Array) -> Any:
        return self._tensor((se3.transform(self._T_world_first, points) - self._origin).astype(np.float32))


@dataclass(frozen=True)
class Measured:
    """One map: its number of points, root mean squares of distances [m] by placing, share of ghosts, and seconds."""

    points: int
    by_path_m: float
    by_poses_m: float
    by_icp_m: float
    by_first_m: float
    ghosts: float
    seconds: float

    def row(self, name: str, best: Measured) -> str:
        """Return one row of the table; the map by true poses, ``best``, is the measure."""
        pairs = [
            (getattr(self, name), getattr(best, name)) for name in ("by_path_m", "by_poses_m", "by_icp_m", "by_first_m")
        ]
        distances = " | ".join(f"{100 * own:.2f} | {own / least:.2f}" for own, least in pairs)
        return f"| {name} | {self.points} | {distances} | {100 * self.ghosts:.3f} | {self.seconds:.1f} |"


def measure(drive: Drive, sequence: Sequence, poses: Trajectory, settings: MapSettings) -> Measured:
    """Build the map of a drive by some poses and compare it with the true surfaces."""
    start = time.process_time()
    points = build_map(sequence, poses, settings).points
    seconds = time.process_time() - start
    assert sequence.reference is not None
    reach_m = float(np.sqrt(np.square(cKDTree(poses.poses[:, :3, 3]).query(points)[0]).mean()))
    by_path, by_poses = (
        se3.transform(align(poses, sequence.reference, lever_m=lever_m).poses[0] @ se3.inverse(poses.poses[0]), points)
        for lever_m in (LEVER_M, reach_m)
    )
    surfaces = Surfaces(drive, points)
    off = surfaces.distances(by_path)
    return Measured(
        len(points),
        rms(off),
        rms(surfaces.distances(by_poses)),
        rms(surfaces.distances(se3.transform(surfaces.alignment(by_path), by_path))),
        rms(surfaces.distances(points)),
        float((off >= GHOST_M).mean()),
        seconds,
    )


def rms(off_m: Array) -> float:
    """Return the root mean square of the distances of points that stand still."""
    return float(np.sqrt((off_m[off_m < GHOST_M] ** 2).mean()))


def measured_drive(config: SimulationConfig) -> Iterator[tuple[str, Measured]]:
    """Yield the maps of a drive, that by true poses first."""
    drive = plan(config)
    whole = drive_recording(drive, config)
    scans = {k: whole[k].scan for k in range(len(whole))}
    sequence = replace(whole, load_scan=scans.__getitem__)
    assert sequence.reference is not None
    yield "true", measure(drive, sequence, sequence.reference, MapSettings())
    yield "true, moving kept", measure(drive, sequence, sequence.reference, MapSettings(remove_moving=False))
    odometry = hl.Odometry()
    estimated = np.array([odometry.step(frame).pose for frame in sequence])
    yield "estimated", measure(drive, sequence, Trajectory(sequence.stamps_ns, estimated), MapSettings())
    yield "smoothed", measure(drive, sequence, hl.smooth(odometry.record()).trajectory, MapSettings())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[9401, 9402])
    parser.add_argument("--length-m", type=float, default=200.0)
    parser.add_argument("--traffic", type=float, default=30.0, help="moving cars a kilometre")
    parser.add_argument("--lidar", default="hdl-64e")
    options = parser.parse_args()
    placings = "".join(f" | {name} [cm] | over true" for name in ("path", "poses", "ICP", "first scan"))
    print(f"| drive, poses | points{placings} | ghosts [%] | s |\n| --- " + "| ---: " * 11 + "|")
    for seed in options.seeds:
        config = SimulationConfig(
            length_m=options.length_m,
            seed=seed,
            lidar=options.lidar,
            traffic_per_km=options.traffic,
            motion_distortion=True,
        )
        best: Measured | None = None
        for name, found in measured_drive(config):
            best = best or found
            print(found.row(f"{seed}, {name}", best), flush=True)


if __name__ == "__main__":
    main()
