"""Measure the time of each stage of preparing a scan: ``python benchmarks/preparation.py SCAN.bin [--runs 20]``.

SCAN.bin is a scan in KITTI's format (float32 x, y, z, reflectance). Prints median and minimum over the runs.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hybridlio.cloud.deskew import constant_twist, deskew
from hybridlio.cloud.ground import find_ground
from hybridlio.cloud.map_geometry import MAP_GEOMETRIES
from hybridlio.cloud.normals import estimate_normals
from hybridlio.cloud.preparation import prepare
from hybridlio.cloud.projection import normal_map, remap, vertex_map
from hybridlio.cloud.voxel import voxel_average, voxel_to_count
from hybridlio.core import se3
from hybridlio.core.sensors import Scan


def stages(points: np.ndarray, threads: int) -> dict[str, Callable[[], object]]:
    geometry = MAP_GEOMETRIES["hdl-64e"]
    vertices = vertex_map(points, geometry)
    normals_of_map, normals = normal_map(vertices), estimate_normals(points, threads=threads)
    keep = ~find_ground(points, normals).mask
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)  # of the sensor's head, which turns in 0.1 s
    T = se3.exp([0, 0, 0.02, 1.2, 0, 0])
    sweep, plain = Scan(0, points, None, (turns * 1e8).astype(np.int64)), Scan(0, points)
    motion = constant_twist(T, -100_000_000, 0)
    return {
        "vertex map": lambda: vertex_map(points, geometry),
        "normal map": lambda: normal_map(vertices),
        "remap": lambda: remap(vertices, normals_of_map, T, geometry),
        "normals": lambda: estimate_normals(points, threads=threads),
        "normals of raw points": lambda: estimate_normals(points, threads=threads, thin_m=0.0),
        "ground": lambda: find_ground(points, normals),
        "voxel average 0.5 m": lambda: voxel_average(points, None, 0.5),
        "voxel to count, without ground": lambda: voxel_to_count(points[keep], normals[keep]),
        "voxel to count, with ground": lambda: voxel_to_count(points, normals),
        "deskew": lambda: deskew(sweep, motion),
        "prepare, thinned only": lambda: prepare(plain).thinned,
        "prepare, both maps": lambda: prepare(plain).normal_map,
        "prepare, loss cloud": lambda: prepare(plain).loss_cloud,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scan", type=Path, metavar="SCAN.bin")
    parser.add_argument("--runs", type=int, default=20, help="of each stage (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="of the normals (default: %(default)s)")
    options = parser.parse_args()
    points = np.ascontiguousarray(np.fromfile(options.scan, np.float32).reshape(-1, 4)[:, :3])
    print(f"{len(points)} points, {options.runs} runs, {options.threads} threads: median and minimum, ms")
    for name, stage in stages(points, options.threads).items():
        stage()
        times = []
        for _ in range(options.runs):
            start = time.perf_counter()
            stage()
            times.append(1e3 * (time.perf_counter() - start))
        print(f"{name:32s} {statistics.median(times):8.2f} {min(times):8.2f}")


if __name__ == "__main__":
    main()
