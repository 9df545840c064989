"""What identifies a run in its journal: recording, settings and version."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from typing import Any

import numpy as np

from hybridlio.core.version import __version__
from hybridlio.datasets.notes import labelled
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config

HEADER_NAMES = (
    "version", "settings", "name", "digest", "stamps_ns", "calibration", "imu_noise", "reference", "pose_file_frame",
    "notes",
)  # fmt: skip


def header_of(sequence: Sequence, config: Config) -> dict[str, Any]:
    """Return what identifies a run, and what smoothing needs beside its estimates."""
    return {
        "version": __version__,
        "settings": config.model_dump(mode="json"),
        "name": sequence.name,
        "digest": _digest(sequence),
        "stamps_ns": sequence.stamps_ns,
        "calibration": sequence.calibration,
        "imu_noise": sequence.imu_noise,
        "reference": sequence.reference,
        "pose_file_frame": sequence.pose_file_frame,
        "notes": labelled(sequence.notes),
    }


def _digest(sequence: Sequence) -> str:
    """Return a digest of everything in the recording but its scans."""
    imu, calibration = sequence.imu, asdict(sequence.calibration)
    arrays = [sequence.stamps_ns, imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2, *calibration.values()]
    arrays += [np.array([fix.stamp_ns, *fix.position_m]) for fix in sequence.gps]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def points_digest(points: Any) -> str:
    """Return a digest of a scan's points, by which another recording is noticed; empty without points."""
    return "" if points is None else hashlib.sha256(np.ascontiguousarray(points).tobytes()).hexdigest()
