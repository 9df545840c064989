"""The memory that a bag takes, however long it is."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import bags
import numpy as np
import pytest

from hybridlio.core.sensors import Scan
from hybridlio.datasets import open_sequence

POINTS, SCANS = 50_000, 60  # 0.8 MB a cloud, 48 MB in all


def messages(maker: bags.Messages) -> Iterator[bags.Message]:
    rng = np.random.default_rng(3)
    yield 0, "/tf_static", "tf2_msgs/msg/TFMessage", maker.tf(maker.transform(0, "imu", "lidar", np.eye(4)))
    for k in range(SCANS):
        at = 10**9 + k * 100_000_000
        scan = Scan(at, rng.uniform(-30, 30, (POINTS, 3)).astype(np.float32))
        yield at, "/points", "sensor_msgs/msg/PointCloud2", maker.cloud(at, bags.structured(scan))
        for n in range(10):
            stamp = at + n * 10_000_000
            yield stamp, "/imu", "sensor_msgs/msg/Imu", maker.imu(stamp, np.zeros(3), np.array([0, 0, 9.81]))


@pytest.mark.parametrize("name", ["long.bag", "long"])
def test_memory_does_not_grow_with_the_bag(name: str, tmp_path: Path) -> None:
    path = bags.write(tmp_path / name, maker := bags.Messages(name == "long"), messages(maker), "mcap")
    tracemalloc.start()
    try:
        sequence = open_sequence(path)
        sizes = [len(frame.scan) for frame in sequence]
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sizes == [POINTS] * SCANS
    assert peak < SCANS * POINTS * 16 / 2, f"{peak / 1e6:.0f} MB"
