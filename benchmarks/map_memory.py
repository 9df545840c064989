"""Measure the memory that the map of a long drive takes, as tiles: 10 km of 64 beams by default.

    python benchmarks/map_memory.py DRIVE OUT [--length-m 10000] [--every-m 4]

The scans of DRIVE, a recording of any length such as a simulated one, are repeated along a straight line, one every
4 m, so that no drive of 10 km is needed. What neighbouring scans see then does not coincide, which gives more voxels
than a real street. Each stage is printed with its processor time and the peak of the process's resident memory so far.
OUT holds the tiles afterwards. Voxels that wait on disk lie in the folder for temporary files, which must be on a disk.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from hybridlio.core.progress import Progress
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.mapping.build import map_tiles
from hybridlio.mapping.settings import MapSettings
from hybridlio.mapping.tile_folder import write_tiles

SPEED_M_S = 10.0
KEPT_SCANS = 40  # in memory, so that reading does not count


def repeated(drive: Sequence, length_m: float, every_m: float) -> Sequence:
    """Return the scans of a recording again and again, one every few metres of a straight line."""
    kept = [drive[k].scan for k in range(min(len(drive), KEPT_SCANS))]
    places = np.arange(0.0, length_m, every_m)
    stamps = np.round(places / SPEED_M_S * NS_PER_S).astype(np.int64)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 3] = places

    def load(k: int) -> Scan:
        scan = kept[k % len(kept)]
        return Scan(int(stamps[k]), scan.points, scan.intensity)

    return Sequence(f"{length_m / 1000:.1f} km", stamps, load, reference=Trajectory(stamps, poses))


def staged() -> Progress:
    """Return a progress callback that prints half and end of each stage."""
    start = time.process_time()

    def report(stage: str, done: int, total: int) -> None:
        if done in (total, total // 2):
            print(f"{stage}: {done} of {total}, {time.process_time() - start:.0f} s, {peak_mib():.0f} MiB", flush=True)

    return report


def peak_mib() -> float:
    """Return the peak of the resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--length-m", type=float, default=10_000.0)
    parser.add_argument("--every-m", type=float, default=4.0)
    options = parser.parse_args()
    sequence = repeated(open_sequence(options.drive), options.length_m, options.every_m)
    report = staged()
    print(f"{sequence.name}, {len(sequence)} scans; before: {peak_mib():.0f} MiB", flush=True)
    with map_tiles(sequence, sequence.reference, MapSettings(), progress=report) as tiles:
        points = write_tiles(options.out, tiles, ".ply", progress=report)
    print(f"{points} points in {len(tiles.names)} tiles, peak {peak_mib():.0f} MiB")


if __name__ == "__main__":
    main()
