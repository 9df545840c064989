"""Measure maps of simulated drives: distance to the true surfaces, moving objects left, and time.

    python benchmarks/maps.py [--seeds 9401 9402] [--length-m 200] [--traffic 30] [--lidar hdl-64e]

For each drive one row for the poses estimated by hybridlio and one for the true ones, which bound what a map can be.
*Ghosts* are points farther than 0.3 m from everything that stands still: what moving cars left behind.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.mapping.build import build_map
from hybridlio.mapping.point_map import PointMap
from hybridlio.mapping.settings import MapSettings
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.measurements import lidar_poses
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.recording import drive_recording
from hybridlio.simulation.world.shapes import merge
from hybridlio.simulation.world.world import TILE_M

GHOST_M = 0.3  # three voxels, and over ten times a range's noise


def distances(drive: Drive, points: Array) -> Array:
    """Return the distance ``(N,)`` of points ``(N, 3)``, in the first scan's frame, to what stands still."""
    import open3d as o3d

    at = se3.transform(lidar_poses(drive)[0], points)
    low, high = (np.floor((f(at[:, :2], axis=0)) / TILE_M).astype(int) for f in (np.min, np.max))
    tiles = [(i, j) for i in range(low[0] - 1, high[0] + 2) for j in range(low[1] - 1, high[1] + 2)]
    mesh = merge([drive.world.tile_mesh(tile) for tile in tiles])
    origin = at.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    vertices = (mesh.vertices - origin).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    return scene.compute_distance(o3d.core.Tensor((at - origin).astype(np.float32))).numpy().astype(np.float64)


def row(name: str, drive: Drive, points: PointMap, seconds: float) -> str:
    """Return one row of the table."""
    off = distances(drive, points.points)
    near = off[off < GHOST_M]
    return (
        f"| {name} | {len(points)} | {100 * np.sqrt((near**2).mean()):.2f} | {100 * np.median(near):.2f} "
        f"| {100 * (off >= GHOST_M).mean():.3f} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[9401, 9402])
    parser.add_argument("--length-m", type=float, default=200.0)
    parser.add_argument("--traffic", type=float, default=30.0, help="moving cars a kilometre")
    parser.add_argument("--lidar", default="hdl-64e")
    options = parser.parse_args()
    print("| drive, poses | points | RMS [cm] | median [cm] | ghosts [%] | seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for seed in options.seeds:
        config = SimulationConfig(
            length_m=options.length_m,
            seed=seed,
            lidar=options.lidar,
            traffic_per_km=options.traffic,
            motion_distortion=True,
        )
        drive = plan(config)
        whole = drive_recording(drive, config)
        scans = {k: whole[k].scan for k in range(len(whole))}
        sequence = replace(whole, load_scan=scans.__getitem__)
        odometry = hl.Odometry()
        estimates = [odometry.step(frame) for frame in sequence]
        estimated = Trajectory(sequence.stamps_ns, np.array([e.pose for e in estimates]))
        assert sequence.reference is not None
        for name, poses, settings in [
            ("estimated", estimated, MapSettings()),
            ("true", sequence.reference, MapSettings()),
            ("true, moving kept", sequence.reference, MapSettings(remove_moving=False)),
        ]:
            start = time.perf_counter()
            built = build_map(sequence, poses, settings)
            print(row(f"{seed}, {name}", drive, built, time.perf_counter() - start), flush=True)


if __name__ == "__main__":
    main()
