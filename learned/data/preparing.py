"""From a recording to a shard. How a scan is prepared is an argument, so that this, too, runs without heavy libraries.

``prepare`` is :func:`hybridlio.cloud.preparation.prepare` with its options, or any callable whose result has maps and
a cloud.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.projection import MapGeometry
from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.imu_rows import imu_rows
from hybridlio.learned.data.shards import ScanRecord, ShardInfo, write_shard


class AveragedCloud(Protocol):
    """Points with normals."""

    @property
    def points(self) -> NDArray[np.float32]:
        """``(K, 3)`` metres."""
        ...

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """``(K, 3)`` unit vectors, zero where there is none."""
        ...


class Mapped(Protocol):
    """What is taken of a prepared scan at run time."""

    @property
    def vertex_map(self) -> NDArray[np.float32]:
        """``(3, H, W)``."""
        ...

    @property
    def usable(self) -> bool:
        """Whether there are points enough."""
        ...


class Prepared(Mapped, Protocol):
    """What is taken of a prepared scan to train by."""

    @property
    def loss_cloud(self) -> AveragedCloud:
        """For the loss."""
        ...


Initial = Callable[[Frame], NDArray[np.float64] | None]
Progress = Callable[[int, int], None]


def prepare_shard(
    sequence: Sequence,
    folder: str | os.PathLike[str],
    prepare: Callable[[Scan], Prepared],
    geometry: MapGeometry,
    imu_samples: int = 15,
    initial: Initial | None = None,
    step: Initial | None = None,
    made_by: str = "",
    progress: Progress | None = None,
) -> ShardInfo:
    """Prepare every scan of a recording once and write the shard.

    A scan that cannot be read is kept as one that is not usable. The velocity at each scan comes from the step before,
    as it would at run time: by ``step`` where that is given, else by the reference where there is one, else by
    ``initial``.

    Args:
        sequence: the recording.
        folder: of the shard.
        prepare: makes a scan ready.
        geometry: the cells that ``prepare`` gives.
        imu_samples: S.
        initial: gives the initial pose ``T_k_k1`` of a frame, or None where there is none.
        step: gives the step ``T_k_k1`` to a frame as odometry found it, or None where it did not: a pair without a
            last velocity is left out of the training of a network that is told of it.
        made_by: kept in the shard's description.
        progress: called with scans done and scans in all.

    Raises:
        DataError: the recording has fewer than two scans.
    """
    records = _records(sequence, prepare, geometry, imu_samples, initial, step, progress)
    return write_shard(folder, records, sequence.name, geometry, imu_samples, made_by)


def _records(
    sequence: Sequence,
    prepare: Callable[[Scan], Prepared],
    geometry: MapGeometry,
    imu_samples: int,
    initial: Initial | None,
    step: Initial | None,
    progress: Progress | None,
) -> Iterator[ScanRecord]:
    before: NDArray[np.float64] | None = None  # the step that led to scan k-1
    for k in range(len(sequence)):
        frame, readable = _frame(sequence, k)
        prepared = prepare(frame.scan) if readable else None
        usable = prepared is not None and prepared.usable
        empty = np.zeros((0, 3), np.float32)
        cloud = prepared.loss_cloud if prepared is not None and usable else None
        normals = empty if cloud is None or cloud.normals is None else cloud.normals
        vertices = np.zeros((3, geometry.rows, geometry.columns), np.float32)
        calibration = frame.calibration
        T_imu_lidar = None if calibration is None else calibration.T_imu_lidar
        guess, reference = initial(frame) if initial is not None and k else None, _step(sequence, k)
        yield ScanRecord(
            vertex_map=prepared.vertex_map if prepared is not None and usable else vertices,
            loss_points=empty if cloud is None else cloud.points,
            loss_normals=normals,
            usable=usable,
            imu=imu_rows(frame.imu, imu_samples, T_imu_lidar) if k and len(frame.imu) else None,
            dt_s=float(sequence.stamps_ns[k] - sequence.stamps_ns[k - 1]) / NS_PER_S if k else 0.0,
            velocity_m_s=_velocity(before, sequence, k),
            initial=guess,
            reference=reference,
        )
        before = step(frame) if step is not None and k else guess if reference is None else reference
        if progress is not None:
            progress(k + 1, len(sequence))


def _frame(sequence: Sequence, k: int) -> tuple[Frame, bool]:
    try:
        return sequence[k], True
    except DataError:
        return sequence.without_scan(k), False


def _step(sequence: Sequence, k: int) -> NDArray[np.float64] | None:
    """``T_{k-1}_{k}`` by the reference."""
    if sequence.reference is None or k < 1:
        return None
    return se3.between(sequence.reference.poses[k - 1], sequence.reference.poses[k])


def _velocity(before: NDArray[np.float64] | None, sequence: Sequence, k: int) -> NDArray[np.float64] | None:
    """Mean velocity from scan k-2 to k-1, in the axes of scan k-1, by the step between them."""
    if before is None:
        return None
    seconds = float(sequence.stamps_ns[k - 1] - sequence.stamps_ns[k - 2]) / NS_PER_S
    return np.asarray(before[:3, :3].T @ before[:3, 3] / seconds)
