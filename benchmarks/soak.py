"""Hours of small scans through an OdometryStream: growth of memory, and of the time a scan takes.

    python benchmarks/soak.py FOLDER [--scans 50000] [--points 4000]

A lap of `long_run.py` with a 16-beam lidar, thinned, is repeated. It is simulated in FOLDER unless FOLDER holds it.
With 50,000 scans this is 83 minutes at ten scans a second. Promised: resident memory grows by less than 100 MiB after
the first 1,000 scans, and the time a scan stays within 10 %.

At the end a new stream joins, and both take turns scan by scan for three laps, so that the load of the machine affects
both alike; the new one's first lap does not count. The ratio of their mean processor times is the growth.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import resident_mib
from long_run import LAP, simulated_lap

from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import Frame
from hybridlio.odometry.stream import OdometryStream

SETTLED = 1000  # scans after which memory counts
COMPARED = 3  # laps
_STEP_NS = 100_000_000


@dataclass
class Laps:
    """Repeated laps, as the data of each scan in order of time."""

    frames: list[Frame]

    def __getitem__(self, k: int) -> Frame:
        """Return the data of scan ``k``, with stamps that go on from lap to lap."""
        frame = self.frames[(k - 1) % LAP + 1 if k else 0]
        shift_ns = self.frames[0].scan.stamp_ns + k * _STEP_NS - frame.scan.stamp_ns
        imu = replace(frame.imu, stamps_ns=frame.imu.stamps_ns + shift_ns)
        return replace(frame, scan=replace(frame.scan, stamp_ns=frame.scan.stamp_ns + shift_ns), imu=imu)


def add(stream: OdometryStream, frame: Frame) -> tuple[int, float]:
    """Add a frame's data; return how many estimates came, and the processor time in milliseconds."""
    start, imu = time.process_time(), frame.imu
    done = stream.add_scan(frame.scan.stamp_ns, frame.scan.points)
    after = slice(1 if frame.index else 0, None)  # the sample at the scan before was added with it
    for sample in zip(imu.stamps_ns[after].tolist(), imu.gyro_rad_s[after], imu.accel_m_s2[after], strict=True):
        done += stream.add_imu(*sample)
    return len(done), 1e3 * (time.process_time() - start)


def thinned(folder: Path, points: int) -> Iterator[Frame]:
    """Yield the frames of the lap with about ``points`` points each."""
    for frame in simulated_lap(folder, "16-beam"):
        every = max(len(frame.scan) // points, 1)
        yield replace(frame, scan=replace(frame.scan, points=frame.scan.points[::every].copy(), intensity=None))


def run(laps: Laps, scans: int) -> dict[str, Any]:
    """Return the figures of a run of ``scans``, and of the laps behind it that a new stream takes too."""
    calibration, noise = laps.frames[0].calibration, laps.frames[0].imu_noise
    stream, memory, spent, estimates = OdometryStream(calibration, imu_noise=noise), {}, [], 0
    for k in range(scans):
        done, cpu_ms = add(stream, laps[k])
        estimates += done
        spent.append(cpu_ms)
        if (k + 1) % SETTLED == 0:
            gc.collect()
            memory[k + 1] = resident_mib()
            print(f"{k + 1} scans: {memory[k + 1]:.0f} MiB, {np.mean(spent[-SETTLED:]):.2f} ms a scan", flush=True)
    first = -(-scans // LAP) * LAP  # the next start of a lap
    for k in range(scans, first):
        add(stream, laps[k])
    fresh = OdometryStream(calibration, imu_noise=noise)
    times = [(add(fresh, laps[k])[1], add(stream, laps[first + k])[1]) for k in range(LAP * (COMPARED + 1))]
    new_ms, old_ms = np.mean(times[LAP:], axis=0)
    counts = stream.counts
    return {
        "scans": scans,
        "points a scan": int(np.median([len(frame.scan) for frame in laps.frames])),
        "estimates": estimates,
        "not estimated": counts.scans - counts.estimates,
        "memory [MiB]": memory,
        "growth of memory after the first 1,000 scans [MiB]": memory[max(memory)] - memory[SETTLED],
        "processor time a scan [ms]": float(old_ms),
        "processor time a scan of a new stream [ms]": float(new_ms),
        "ratio": float(old_ms / new_ms),
    }


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the lap")
    parser.add_argument("--scans", type=int, default=50_000, help="length of the run (default: %(default)s)")
    parser.add_argument("--points", type=int, default=4000, help="points a scan, roughly (default: %(default)s)")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="for all figures as JSON")
    options = parser.parse_args()
    if options.scans < SETTLED:
        parser.error(f"--scans: at least {SETTLED}")
    found = run(Laps(list(thinned(options.folder, options.points))), options.scans)
    print(json.dumps(found, indent=2))
    if options.out is not None:
        write_atomically(options.out, json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
