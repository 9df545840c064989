"""Check that a resumed odometry continues as the one whose state it has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hybridlio.core.sensors import Frame, Scan
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.plain_values import decode, encode


def without_points(frames: list[Frame], estimates: list[Estimate]) -> Iterator[tuple[Frame, Estimate]]:
    for frame, estimate in zip(frames, estimates, strict=True):
        yield replace(frame, scan=Scan(frame.scan.stamp_ns, np.empty((0, 3), np.float32))), estimate


def check_resumed_at(cut: int, frames: list[Frame], config: Config) -> None:
    whole = Odometry(config=config)
    estimates = [whole.step(frame) for frame in frames[:cut]]
    stored = encode([estimates, whole.state()])
    estimates += [whole.step(frame) for frame in frames[cut:]]
    resumed = Odometry(config=config)
    before, state = decode(stored)
    assert resumed.resume(without_points(frames[:cut], before), state) == 0
    for expected, frame in zip(estimates[cut:], frames[cut:], strict=True):
        found = resumed.step(frame)
        assert found.gate == expected.gate
        for name in ("pose", "covariance"):
            assert np.array_equal(getattr(found, name), getattr(expected, name)), (frame.index, name)
    one, other = whole.record(), resumed.record()
    assert np.array_equal(one.online.poses, other.online.poses)
    assert np.array_equal(one.imu.stamps_ns, other.imu.stamps_ns)
    assert one.keyframes is not None
    assert other.keyframes is not None
    assert [a.tolist() for a in one.keyframes.clouds] == [b.tolist() for b in other.keyframes.clouds]
