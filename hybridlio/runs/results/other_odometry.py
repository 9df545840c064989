"""The poses of another odometry as a run, so that their smoothing is written and reported as that of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.trajectory import Trajectory
from hybridlio.core.version import __version__
from hybridlio.evaluation.evaluate import Steps
from hybridlio.record.record import Record
from hybridlio.runs.folder import StoredRun


def as_stored_run(path: Path, record: Record, reference: Trajectory | None = None) -> StoredRun:
    """Return a record of another odometry as a run of the name of its file.

    Args:
        path: of the file of poses.
        record: of it.
        reference: the ground truth, if there is one.
    """
    T = record.calibration.T_camera_lidar
    steps = Steps(
        np.array([step.pose for step in record.relative]), np.array([step.covariance for step in record.relative])
    )
    metrics = {
        "hybridlio": __version__,
        "sequence": path.stem,
        "frames": len(record.online),
        "frames_done": len(record.online),
        "notes": list(record.notes),
        "imu_time_offset_s": record.imu_time_offset_s,
        "pose_file_frame": "lidar" if T is None else "camera",
    }
    metrics |= {} if T is None else {"T_camera_lidar": T.tolist()}
    return StoredRun(path, record.online, np.zeros(0, np.int64), steps, reference, metrics)
