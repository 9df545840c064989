"""Play a bag at real speed into an OdometryStream, as a robot would deliver it, and print the delay of the estimates.

python examples/stream_bag.py BAG [SPEED]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

import hybridlio as hl
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.choices import BagTopics
from hybridlio.datasets.rosbag.clouds import livox_columns
from hybridlio.datasets.rosbag.live import LiveClouds, imu_sample
from hybridlio.datasets.rosbag.topics import LIVOX_TYPES, choose
from hybridlio.datasets.rosbag.wire import read_header


def main(path: str, speed: str = "1") -> None:
    recording = hl.open_sequence(path)  # for the extrinsics, which a robot's program knows
    bag = Bag(Path(path))
    topics = choose(bag, BagTopics(), Notes(bag.path.name))
    lidar = topics["lidar"]
    sent_s: dict[int, float] = {}
    delays_s: list[float] = []
    estimates: list[hl.Estimate] = []

    def take(estimate: hl.Estimate) -> None:
        delays_s.append(time.perf_counter() - sent_s[estimate.stamp_ns])
        estimates.append(estimate)

    calibration = recording.calibration if "imu" in topics else None
    clouds, start_s, first_ns = LiveClouds(), time.perf_counter(), None
    with hl.OdometryStream(calibration, on_estimate=take, imu_noise=recording.imu_noise) as stream:
        wanted = [topics[kind].name for kind in ("lidar", "imu") if kind in topics]
        for topic, received_ns, raw in bag.messages(wanted):
            first_ns = received_ns if first_ns is None else first_ns
            ahead_s = (received_ns - first_ns) / 1e9 / float(speed) - (time.perf_counter() - start_s)
            time.sleep(max(ahead_s, 0.0))
            if topic != lidar.name:
                stream.add_imu(*imu_sample(bag.decode(topic, raw)))
            elif lidar.type in LIVOX_TYPES:
                stamp_ns = read_header(raw, bag.is_ros2).stamp_ns
                scans = clouds.add_columns(stamp_ns, livox_columns(raw, bag.is_ros2, stamp_ns))
            else:
                scans = clouds.add(bag.decode(topic, raw))
            for scan in scans if topic == lidar.name else ():
                sent_s[scan.stamp_ns] = time.perf_counter()
                stream.add_scan(scan.stamp_ns, scan.points, scan.time_offsets_ns)
    print(f"{len(estimates)} estimates of {len(recording)} scans; {stream.counts}")
    print(f"from scan to estimate: median {1e3 * np.median(delays_s):.0f} ms, largest {1e3 * max(delays_s):.0f} ms")


if __name__ == "__main__":
    main(*sys.argv[1:])
