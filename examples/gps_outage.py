"""Fuse odometry and IMU with GPS fixes that have a clock offset, an outlier, and an outage for a third of the drive.

python examples/gps_outage.py [FOLDER]
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import hybridlio as hl
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.evaluation.ate_rpe import ate
from hybridlio.record.record import Record
from hybridlio.simulation.chain import ChainSettings, make_chain
from hybridlio.smoothing.georeference import georeference, write_georeferenced
from hybridlio.smoothing.gps_options import GpsOptions

LATE_S, SIGMA_M = 0.3, 0.2
ORIGIN = GeodeticPoint(49.0, 8.4, 110.0)


def main(folder: str | None = None, *_: str) -> None:
    poor = np.r_[np.full(3, 4e-3), np.full(3, 0.08)]  # rad, m: large errors per step
    drive = make_chain(5, ChainSettings(steps=200, step_sigmas=poor))  # 20 s
    stamps = np.array([frame.scan.stamp_ns for frame in drive.frames])
    poses = [np.eye(4)]
    for step in drive.relative:
        poses.append(poses[-1] @ step.pose)
    odometry, truth = hl.Trajectory(stamps, np.array(poses)), hl.Trajectory(stamps, drive.lidar_poses)

    rng = np.random.default_rng(1)
    # two fixes per second, of an antenna at the IMU
    antenna = drive.poses[::5, :3, 3] + SIGMA_M * rng.standard_normal((41, 3))
    late = stamps[::5] + round(LATE_S * 1e9)
    fixes = tuple(hl.GpsFix(int(t), p, SIGMA_M**2 * np.eye(3), ORIGIN) for t, p in zip(late, antenna, strict=True))
    fixes = (*fixes[:5], replace(fixes[5], position_m=fixes[5].position_m + 30), *fixes[6:])  # an outlier

    record = Record.from_odometry(
        odometry, drive.record(odometry.poses).imu, fixes, drive.calibration, covariances=drive.relative[0].covariance
    )
    outage = (int(stamps[70]), int(stamps[135]))
    for name, gps in (("without GPS", False), ("with GPS", True), ("with an outage", GpsOptions(outages=[outage]))):
        smoothed = hl.smooth(record, gps=gps)
        print(f"{name}: ATE {ate(smoothed.trajectory, truth, lever_m=0.0).rmse_m:.3f} m")
    print(f"GPS with the outage: {smoothed.found['gps'].summary()}")
    placed = georeference(record, smoothed.trajectory)
    for path in write_georeferenced(Path(folder or tempfile.mkdtemp(prefix="hybridlio-")), placed):
        print(f"wrote {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
