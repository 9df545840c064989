"""Latency of an OdometryStream that gets a recording at real speed, and the time of its predictions.

    python benchmarks/stream_latency.py DATA [--sequence NAME] [--frames A:B] [--speed 1] [-o FILE]

Every measurement is added at its stamp, a scan at its last point, and a prediction is asked for at every IMU sample, as
a robot's node does. Scans are read beforehand. Prints

* the latency: from the call of add_scan, the copy included, to the call of on_estimate;
* the time that a scan took to estimate, and its share over 100 ms;
* scans skipped, because the machine was too slow;
* the time of predict, by the wall's clock (which includes waiting for Python's lock while a scan is estimated) and by
  the processor time of the calling thread.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import open_part

from hybridlio.core.errors import HybridLioError
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.stream import OdometryStream

REAL_TIME_MS = 100.0  # between scans of a lidar that turns ten times a second


def arrivals(recording: Sequence) -> Iterator[tuple[int, Scan | int]]:
    """Yield the time of arrival and a scan, or the row of an IMU sample, in order."""
    scans = [recording[k].scan for k in range(len(recording))]
    ends = [s.stamp_ns + (0 if s.time_offsets_ns is None else int(s.time_offsets_ns.max())) for s in scans]
    inside = recording.imu.stamps_ns <= ends[-1] + NS_PER_S // 10
    data: list[tuple[int, Scan | int]] = [*zip(ends, scans, strict=True)]
    data += [(int(stamp), row) for row, stamp in enumerate(recording.imu.stamps_ns[inside])]
    yield from sorted(data, key=lambda pair: pair[0])


def run(recording: Sequence, speed: float) -> dict[str, Any]:
    """Play the recording and return the figures."""
    added_s: dict[int, float] = {}
    latency_ms: list[float] = []
    spent_ms: list[float] = []
    predicted_ms: list[tuple[float, float]] = []
    imu = recording.imu

    def take(estimate: Estimate) -> None:
        latency_ms.append(1e3 * (time.perf_counter() - added_s[estimate.stamp_ns]))
        spent_ms.append(1e3 * sum(estimate.seconds.values()))

    calibration = recording.calibration if len(imu) else None
    data = list(arrivals(recording))
    warm_up = Odometry()  # loads the libraries
    for frame in recording.part(0, min(3, len(recording))):
        warm_up.step(frame)
    odometry = Odometry(keep_record=False) if len(imu) else None
    first_ns = max(data[0][0], int(recording.stamps_ns[0]) - NS_PER_S)
    with OdometryStream(calibration, odometry, take, imu_noise=recording.imu_noise) as stream:
        cpu_s, start_s = time.process_time(), time.perf_counter()
        for at_ns, datum in data:
            time.sleep(max((at_ns - first_ns) / NS_PER_S / speed - (time.perf_counter() - start_s), 0.0))
            if isinstance(datum, Scan):
                added_s[datum.stamp_ns] = time.perf_counter()
                stream.add_scan(datum.stamp_ns, datum.points, datum.time_offsets_ns)
                continue
            stream.add_imu(at_ns, imu.gyro_rad_s[datum], imu.accel_m_s2[datum])
            wall_s, thread_s = time.perf_counter(), time.thread_time()
            try:
                stream.predict(at_ns)
            except HybridLioError:  # before the second estimate
                continue
            predicted_ms.append((1e3 * (time.perf_counter() - wall_s), 1e3 * (time.thread_time() - thread_s)))
    counts = stream.counts
    wall, thread = np.array(predicted_ms).T if predicted_ms else (np.zeros(1), np.zeros(1))
    latency, spent = np.array(latency_ms), np.array(spent_ms[1:])
    return {
        "recording": recording.name,
        "points a scan": int(np.median([len(d) for _, d in data if isinstance(d, Scan)])),
        "scans": counts.scans,
        "skipped": counts.skipped_scans,
        "latency, median [ms]": float(np.median(latency)),
        "latency, 99th percentile [ms]": float(np.percentile(latency, 99)),
        f"latency over {REAL_TIME_MS:.0f} ms [%]": 100 * float((latency > REAL_TIME_MS).mean()),
        "estimation, median [ms]": float(np.median(spent)),
        "estimation, 99th percentile [ms]": float(np.percentile(spent, 99)),
        f"estimation over {REAL_TIME_MS:.0f} ms [%]": 100 * float((spent > REAL_TIME_MS).mean()),
        "processor time a scan, all threads [ms]": 1e3 * (time.process_time() - cpu_s) / max(counts.estimates, 1),
        "predict, median [ms]": float(np.median(wall)),
        "predict, 99th percentile [ms]": float(np.percentile(wall, 99)),
        "predict, processor time, median [ms]": float(np.median(thread)),
        "predict, processor time, 99th percentile [ms]": float(np.percentile(thread, 99)),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "threads": threading.active_count(),
    }


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording")
    parser.add_argument("--sequence", metavar="NAME", help="which, if there are several")
    parser.add_argument("--frames", metavar="A:B", help="frames of the recording (default: all)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real speed (default: %(default)s)")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="for the figures as JSON")
    options = parser.parse_args()
    found = run(open_part(options.data, options.sequence, options.frames), options.speed)
    for name, value in found.items():
        print(f"{name}: {value:.2f}" if isinstance(value, float) else f"{name}: {value}")
    if options.out is not None:
        write_atomically(options.out, json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
