"""Smooth KISS-ICP's odometry of KITTI 00, all 4,541 poses, with the recording's own IMU and GPS.

python benchmarks/kitti_00.py DATA [odometry imu gps outage …] [--outage-s 60]

DATA holds `results/kiss_icp_00/00_poses_kitti.txt` (KISS-ICP's odometry), `kitti_imu_100hz` (accelerometer, gyroscope
and GPS fixes of the same drive), and `kitti_odometry` with calibration, times and ground truth. The ground truth serves
evaluation alone: the noise of the odometry is estimated from its agreement with the IMU, that of the IMU is the
library's default, and the offset of the clocks is estimated. `imu` smooths odometry and IMU, `gps` adds all fixes, and
`outage` leaves out 60 s of fixes, at `--places` places along the drive in turn.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from common import nanoseconds

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import read_kitti
from hybridlio.datasets.imu_faults import without_filled_gaps
from hybridlio.evaluation.ate_rpe import align, associate
from hybridlio.record.imu_clock import on_poses_clock
from hybridlio.record.odometry_noise import odometry_noise
from hybridlio.record.record import Record
from hybridlio.smoothing.gps_alignment import fix_stamps
from hybridlio.smoothing.gps_options import GpsOptions

# calib_imu_to_velo.txt of 2011_10_03, as KITTI publishes it
T_LIDAR_IMU = se3.make(
    [
        [0.9999976, 7.553071e-4, -2.035826e-3],
        [-7.854027e-4, 0.9998898, -1.482298e-2],
        [2.024406e-3, 1.482454e-2, 0.9998881],
    ],
    [-0.8086759, 0.3195559, -0.7997231],
)
FIX_SIGMA_M = 0.07  # the recording states no accuracy; smoothing raises this to the scatter of the fixes


def read(data: Path) -> tuple[hl.Trajectory, hl.Trajectory, hl.ImuSamples, tuple[hl.GpsFix, ...]]:
    """Return truth, odometry, IMU samples and GPS fixes; times of the last two start at the first inertial row."""
    folder = data / "kitti_odometry"
    seconds = np.loadtxt(folder / "00/times.txt")
    rows = dict(line.split(":") for line in (folder / "00/calib.txt").read_text().splitlines() if ":" in line)
    T_camera_lidar = np.vstack([np.array(rows["Tr"].split(), float).reshape(3, 4), [0, 0, 0, 1]])
    stamps = nanoseconds(seconds)
    truth = read_kitti(folder / "poses/00.txt", stamps, T_camera_lidar)
    odometry = read_kitti(data / "results/kiss_icp_00/00_poses_kitti.txt", stamps, T_camera_lidar)
    raw = np.loadtxt(data / "kitti_imu_100hz/imu_100hz.txt")
    fixes = np.loadtxt(data / "kitti_imu_100hz/KittiGps_converted.txt", delimiter=",", skiprows=1)
    imu = hl.ImuSamples(nanoseconds(raw[:, 0] - raw[0, 0]), raw[:, 5:8], raw[:, 2:5])
    covariance = FIX_SIGMA_M**2 * np.eye(3)
    times = nanoseconds(fixes[:, 0] - raw[0, 0]).tolist()
    return truth, odometry, imu, tuple(hl.GpsFix(t, p, covariance) for t, p in zip(times, fixes[:, 1:], strict=True))


def make_record(odometry: hl.Trajectory, imu: hl.ImuSamples, gps: tuple[hl.GpsFix, ...]) -> Record:
    measured, gaps = without_filled_gaps(imu)
    calibration = hl.Calibration(se3.inverse(T_LIDAR_IMU))
    on_clock = on_poses_clock(odometry, measured, calibration)
    print(f"IMU: stamps moved by {1e3 * on_clock.offset_s:.1f} ms; {len(gaps)} interpolated gaps removed")
    noise = odometry_noise(odometry, on_clock.imu, calibration)
    for part, covariances in (("odometry noise per step", noise.covariances), ("of which drift", noise.drifts)):
        sigmas = np.sqrt(np.median(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
        print(f"{part:>24s} {np.round(1e3 * sigmas[:3], 2)} mrad, {np.round(1e2 * sigmas[3:], 2)} cm")
    return Record.from_odometry(odometry, on_clock.imu, gps, calibration, imu_time_offset_s=0.0)


def report(name: str, truth: hl.Trajectory, estimate: hl.Trajectory, time_spent: str = "") -> None:
    e = hl.evaluate(estimate, truth)
    figures = f"ATE {e.ate_m:6.3f} m  t_rel {e.t_rel_percent:.3f} %  r_rel {e.r_rel_deg_per_100m:.3f} °/100 m"
    print(f"{name:24s} {figures}  RPE {e.rpe_m:.4f} m {e.rpe_deg:.4f}°  {time_spent}", flush=True)


def smooth(name: str, truth: hl.Trajectory, record: Record, gps: GpsOptions | None) -> None:
    begin = time.process_time()
    smoothed = hl.smooth(record, gps=gps or False)
    report(name, truth, smoothed.trajectory, f"{time.process_time() - begin:.0f} s processor time")
    if gps is not None:
        print(f"{'':24s} {smoothed.found['gps'].summary()}")
    for start, end in gps.outages if gps is not None else ():
        both = associate(smoothed.trajectory, truth)
        inside = (both.reference.stamps_ns >= start) & (both.reference.stamps_ns <= end)
        aligned = align(both.estimate, both.reference, lever_m=0.0).poses[inside, :3, 3]
        off = np.linalg.norm(aligned - both.reference.poses[inside, :3, 3], axis=1)
        print(
            f"{'':24s} during the outage: RMSE {np.sqrt((off**2).mean()):.2f} m, at most {off.max():.2f} m", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("parts", nargs="*", default=["odometry", "imu", "gps", "outage"])
    parser.add_argument("--outage-s", type=float, default=60.0, help="length of an outage (default: %(default)s)")
    parser.add_argument("--places", type=int, default=8, help="number of outages, one a run (default: %(default)s)")
    options = parser.parse_args()
    truth, odometry, imu, gps = read(options.data)
    record = make_record(odometry, imu, gps)
    if "odometry" in options.parts:
        report("odometry alone", truth, odometry)
    if "imu" in options.parts:
        smooth("with IMU", truth, record, None)
    if "gps" in options.parts:
        smooth("with IMU and GPS", truth, record, GpsOptions())
    if "outage" in options.parts:
        stamps = fix_stamps(gps)
        length = round(options.outage_s * NS_PER_S)
        for start in np.linspace(stamps[0], stamps[-1] - length, options.places).astype(np.int64).tolist():
            outage = GpsOptions(outages=[(start, start + length)])
            smooth(f"outage from {start / NS_PER_S:5.0f} s", truth, record, outage)


if __name__ == "__main__":
    main()
