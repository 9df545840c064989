"""A recording of a published data set: what its reader gathers, and the sequence made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.datasets.calibration_yaml import StatedCalibration, read_calibration_yaml
from hybridlio.datasets.imu_mounting import as_stated, note_mounting
from hybridlio.datasets.kitti.vertical_angle import raised
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_files import open_point_files
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.reference import poses_at
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import MISSING_STAMP, SCAN_GAP_FACTOR, note_coverage, note_gaps, usable_scans

NO_TIMES = StatedTimes(ignored=True)


@dataclass(frozen=True)
class Layout:
    """A published data set's layout, as the registry of readers takes it.

    Attributes:
        text: description of the layout, for messages.
        is_recording: whether a folder is a recording.
        gather: returns what a recording holds.
        below: patterns of the folders below a path that may be recordings.
        listed: returns the recordings at or below a path by name, where they are no folders; None where they are.
    """

    text: str
    is_recording: Callable[[Path], bool]
    gather: Callable[[Path, Notes], Recording]
    below: tuple[str, ...] = ("*",)
    listed: Callable[[Path], dict[str, Path]] | None = None

    def find(self, path: Path) -> dict[str, Path]:
        """Find the recordings at or below ``path``: folders by name."""
        if self.listed is not None:
            return self.listed(path)
        if self.is_recording(path):
            return {path.resolve().name.removesuffix("_sync"): path}
        below = (p for pattern in self.below for p in sorted(path.glob(pattern)))
        return {p.name.removesuffix("_sync"): p for p in below if self.is_recording(p)}

    def open(self, path: Path, vertical_angle_deg: float | None = None) -> Sequence:
        """Open a recording.

        Args:
            path: one of :attr:`find`.
            vertical_angle_deg: angle by which points are raised; none by default.

        Raises:
            DataError: a file is missing or malformed; the message names it.
            ConfigError: ``vertical_angle_deg`` is over 5°.
        """
        notes = Notes(path.name.removesuffix("_sync"))
        return sequence_of(self.gather(path, notes), notes, vertical_angle_deg)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a reader gathers from a recording's files.

    Attributes:
        folder: the recording's folder, in which a ``calibration.yaml`` may override what is built in.
        paths: one file per scan.
        stamps_ns: one stamp per scan, not checked yet.
        layout: the columns of ``.bin`` scans.
        read: reads the columns of a scan file, for formats of the data set's own.
        times: the meaning of the points' times; :data:`NO_TIMES` if the points are compensated or have none.
        imu: the samples; may be empty.
        T_imu_lidar: ``(4, 4)``.
        poses: stamps ``(R,)`` and lidar poses ``(R, 4, 4)`` in any fixed frame; None without a reference.
        lidar: the lidar's model, or None.
    """

    folder: Path
    paths: tuple[Path, ...]
    stamps_ns: Stamps
    layout: BinLayout | None = None
    read: Callable[[Path], Columns] | None = None
    times: StatedTimes = NO_TIMES
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    T_imu_lidar: Array = field(default_factory=lambda: np.eye(4))
    poses: tuple[Stamps, Array] | None = None
    lidar: LidarModel | None = None


def sequence_of(found: Recording, notes: Notes, vertical_angle_deg: float | None = None) -> Sequence:
    """Return the sequence of a recording: scans whose stamps increase, IMU on their clock, reference at their stamps.

    Raises:
        DataError: there are no scans, their stamps hardly increase, or the points cannot be read.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    stamps, paths = _usable(found, notes)
    stated = read_calibration_yaml(found.folder / "calibration.yaml")
    mounting = _mounting(found, stated, notes)
    imu = found.imu
    if len(imu):
        imu = as_stated(imu, stated.imu_scale, stated.imu_time_offset_s, notes)
        note_mounting(imu, mounting.T_imu_lidar, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    points = replace(stated.format, times=stated.format.times or found.times)
    scans = open_point_files(paths, stamps, notes, stated.layout or found.layout, points, found.read)
    reference = found.poses and poses_at(stamps, *found.poses, "reference poses", notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=raised(scans, vertical_angle_deg),
        imu=imu,
        calibration=mounting,
        reference=reference,
        lidar=stated.lidar or found.lidar,
        imu_noise=stated.imu_noise,
        imu_time_offset_s=stated.imu_time_offset_s,
        imu_scale=stated.imu_scale,
        notes=tuple(notes.texts),
    )


def _usable(found: Recording, notes: Notes) -> tuple[Stamps, tuple[Path, ...]]:
    if not found.paths:
        raise DataError(f"{found.folder}: no scans")
    stamps = found.stamps_ns
    if len(stamps) != len(found.paths) or (stamps == MISSING_STAMP).any():
        raise DataError(f"{found.folder}: {len(stamps)} stamps for {len(found.paths)} scans; each scan needs one")
    keep = usable_scans(stamps, found.paths[0].parent)
    if len(keep) < len(stamps):
        first = found.paths[int(np.setdiff1d(np.arange(len(stamps)), keep)[0])].name
        notes.corrected(f"dropped {len(stamps) - len(keep)} scans whose stamps repeat or go backwards, first {first}")
    note_gaps(stamps[keep], "scans", notes, SCAN_GAP_FACTOR)
    return stamps[keep], tuple(found.paths[k] for k in keep)


def _mounting(found: Recording, stated: StatedCalibration, notes: Notes) -> Calibration:
    """Return the extrinsics that ``calibration.yaml`` states, else the built-in ones."""
    given = stated.calibration
    if "T_imu_lidar" in stated.keys:
        notes.found(f"T_imu_lidar is that of {found.folder / 'calibration.yaml'}")
        return given
    return Calibration(found.T_imu_lidar, given.T_camera_lidar, given.antenna_imu_m)
