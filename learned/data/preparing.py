"""Conversion of a recording to a shard. Scan preparation is an argument, so that this needs no heavy libraries.

``prepare`` is :func:`hybridlio.cloud.preparation.prepare` with its options, or any callable whose result has maps and
a cloud.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.imu_rows import imu_rows
from hybridlio.learned.data.shards import ScanRecord, ShardInfo, write_shard
from hybridlio.learned.settings import NetworkSettings

StepOf = Callable[[Frame], NDArray[np.float64] | None]
"""Returns a step ``T_k_k1`` ``(4, 4)`` that leads to a frame, or None if unknown."""


class AveragedCloud(Protocol):
    """Points with normals."""

    @property
    def points(self) -> NDArray[np.float32]:
        """``(K, 3)`` metres."""
        ...

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """``(K, 3)`` unit vectors, zero where a point has none."""
        ...


class Mapped(Protocol):
    """The part of a prepared scan that a network needs at run time."""

    @property
    def vertex_map(self) -> NDArray[np.float32]:
        """``(3, H, W)`` metres, 0 in empty cells."""
        ...

    @property
    def usable(self) -> bool:
        """Whether the scan has enough points."""
        ...


class Prepared(Mapped, Protocol):
    """The part of a prepared scan that training needs."""

    @property
    def loss_cloud(self) -> AveragedCloud:
        """The points that the loss is computed from."""
        ...


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """Sources of a recording's motion other than its reference.

    Attributes:
        initial: returns the initial pose of a frame, for a network whose initial poses are given.
        step: returns the step to a frame as odometry found it. A pair whose previous step is not known has no last
            velocity, and a network that needs one does not train on it.
        source: origin of these; stored in the shard's description.
    """

    initial: StepOf | None = None
    step: StepOf | None = None
    source: str = ""


def prepare_shard(
    sequence: Sequence,
    folder: str | os.PathLike[str],
    prepare: Callable[[Scan], Prepared],
    network: NetworkSettings,
    motion: KnownMotion | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ShardInfo:
    """Prepare every scan of a recording and write the shard.

    A scan that cannot be read becomes a record that is not usable. The velocity at each scan is that of the step
    before, as at run time: by ``motion.step`` if given, else by the reference if available, else by
    ``motion.initial``.

    Args:
        sequence: the recording.
        folder: folder of the shard.
        prepare: prepares a scan, with the map geometry of ``network``.
        network: determines the map geometry and the number of IMU rows.
        motion: initial poses and steps, if known.
        progress: called with the number of scans done and the total.

    Raises:
        DataError: the recording has fewer than two scans.
    """
    motion = motion or KnownMotion()
    records = _records(sequence, prepare, network, motion, progress)
    return write_shard(folder, records, sequence.name, network.geometry, network.imu_samples, motion.source)


def _records(
    sequence: Sequence,
    prepare: Callable[[Scan], Prepared],
    network: NetworkSettings,
    motion: KnownMotion,
    progress: Callable[[int, int], None] | None,
) -> Iterator[ScanRecord]:
    last_step: NDArray[np.float64] | None = None  # the step that led to scan k-1
    for k in range(len(sequence)):
        frame, readable = _frame(sequence, k)
        record = _scan_record(prepare(frame.scan) if readable else None, network.geometry)
        if k:
            guess, reference = _asked(motion.initial, frame), _reference_step(sequence, k)
            yield replace(
                record,
                imu=_imu(frame, network.imu_samples),
                dt_s=float(sequence.stamps_ns[k] - sequence.stamps_ns[k - 1]) / NS_PER_S,
                velocity_m_s=_velocity(last_step, sequence, k),
                initial=guess,
                reference=reference,
            )
            last_step = _asked(motion.step, frame) if motion.step else guess if reference is None else reference
        else:
            yield record
        if progress is not None:
            progress(k + 1, len(sequence))


def _scan_record(scan: Prepared | None, geometry: MapGeometry) -> ScanRecord:
    """Return the part of a record that depends on the scan only; empty if the scan is not usable."""
    empty = np.zeros((0, 3), np.float32)
    if scan is None or not scan.usable:
        return ScanRecord(np.zeros((3, geometry.rows, geometry.columns), np.float32), empty, empty, usable=False)
    cloud = scan.loss_cloud
    return ScanRecord(scan.vertex_map, cloud.points, empty if cloud.normals is None else cloud.normals)


def _asked(step: StepOf | None, frame: Frame) -> NDArray[np.float64] | None:
    return None if step is None else step(frame)


def _imu(frame: Frame, samples: int) -> NDArray[np.float32] | None:
    if not len(frame.imu):
        return None
    return imu_rows(frame.imu, samples, None if frame.calibration is None else frame.calibration.T_imu_lidar)


def _frame(sequence: Sequence, k: int) -> tuple[Frame, bool]:
    try:
        return sequence[k], True
    except DataError:
        return sequence.without_scan(k), False


def _reference_step(sequence: Sequence, k: int) -> NDArray[np.float64] | None:
    """Return ``T_{k-1}_{k}`` by the reference, None without one."""
    if sequence.reference is None:
        return None
    return se3.between(sequence.reference.poses[k - 1], sequence.reference.poses[k])


def _velocity(step: NDArray[np.float64] | None, sequence: Sequence, k: int) -> NDArray[np.float64] | None:
    """Return the mean velocity from scan k-2 to k-1 in the axes of scan k-1, by the step between them."""
    if step is None:
        return None
    seconds = float(sequence.stamps_ns[k - 1] - sequence.stamps_ns[k - 2]) / NS_PER_S
    return np.asarray(step[:3, :3].T @ step[:3, 3] / seconds)
