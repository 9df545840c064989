"""Feed a recording to a stream as sensors would."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.stream import OdometryStream

MS = 1_000_000


@dataclass(frozen=True)
class Event:
    """A measurement: when it arrives, and the method of the stream that takes it, with its arguments."""

    arrival_ns: int
    method: str
    arguments: tuple[Any, ...]

    def add_to(self, stream: OdometryStream) -> list[Estimate]:
        estimates: list[Estimate] = getattr(stream, self.method)(*self.arguments)
        return estimates


def events(sequence: Sequence, delay: Callable[[], int] = lambda: 0) -> list[Event]:
    """Return all data of a recording in order of arrival: each at its stamp (a scan at its end) and a delay in ns."""
    found = []
    for k in range(len(sequence)):
        scan = sequence.load_scan(k)
        end_ns = scan.stamp_ns + (0 if scan.time_offsets_ns is None else int(scan.time_offsets_ns.max()))
        found.append(Event(end_ns + delay(), "add_scan", (scan.stamp_ns, scan.points, scan.time_offsets_ns)))
    imu = sequence.imu
    for stamp_ns, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        found.append(Event(stamp_ns + delay(), "add_imu", (stamp_ns, gyro, accel)))
    for fix in sequence.gps:
        arguments = (fix.stamp_ns, fix.position_m, fix.covariance_m2, fix.origin)
        found.append(Event(fix.stamp_ns + delay(), "add_fix", arguments))
    return sorted(found, key=lambda event: event.arrival_ns)


def feed(stream: OdometryStream, data: Iterable[Event]) -> list[Estimate]:
    """Return the estimates of all events, and those of a flush at the end."""
    return [estimate for event in data for estimate in event.add_to(stream)] + stream.flush()


def thinned(sequence: Sequence, every: int) -> Sequence:
    """Return the recording with every n-th point."""

    def load(k: int) -> Any:
        scan = sequence.load_scan(k)
        return replace(scan, points=scan.points[::every], intensity=None)

    return replace(sequence, load_scan=load)


def with_point_times(sequence: Sequence) -> Sequence:
    """Return the recording with points measured from 60 ms before to 40 ms after the stamps."""

    def load(k: int) -> Any:
        scan = sequence.load_scan(k)
        return replace(scan, time_offsets_ns=np.linspace(-60 * MS, 40 * MS, len(scan)).astype(np.int64))

    return replace(sequence, load_scan=load)


def without_imu(sequence: Sequence) -> Sequence:
    return replace(sequence, imu=ImuSamples.empty(), calibration=Calibration())


def same(one: Estimate, other: Estimate) -> bool:
    """Return whether two estimates agree to the last bit."""
    pairs = [(one.pose, other.pose), (one.covariance, other.covariance)]
    for a, b in ((one.initial, other.initial), (one.relative, other.relative), (one.step, other.step)):
        if a is None or b is None:
            if a is not b:
                return False
        else:
            pairs += [(a.pose, b.pose), (a.covariance, b.covariance)]
    return one.stamp_ns == other.stamp_ns and all(a.tobytes() == b.tobytes() for a, b in pairs)


def stream_of(recording: Sequence, **options: object) -> OdometryStream:
    """Return a stream with the sensors of a recording."""
    calibration = recording.calibration if len(recording.imu) else None
    return OdometryStream(calibration, imu_noise=recording.imu_noise, **options)  # type: ignore[arg-type]
