"""Start runs whose IMU wakes up after the first scan, and compare the first poses with their covariances.

    python benchmarks/late_imu.py FOLDER [--kinds campus-handheld,campus-drone] [--seeds 1,2] [--late-ms 0,50,100,150]

Each kind and seed gives a short recording, simulated below FOLDER unless it is there, whose first samples of the IMU
are left out. ANEES is over the first ten poses after the start, relative to the first scan; beyond 12 is the share of
poses whose squared error over three axes is unlikely (0.7 %) with a right covariance.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import trajectory_of
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.simulate import simulate_platform

SCANS, SECONDS = 11, 1.3
UNLIKELY = 12.0


def recording(folder: Path, kind: str, lidar: str, seed: int) -> Sequence:
    scene, platform = kind.split("-")
    config = PlatformConfig(scene=scene, platform=platform, lidar=lidar, seed=seed, seconds=SECONDS)
    with progress(f"simulating {config.name}") as report:
        return open_sequence(simulate_platform(folder, config, report))


def late(sequence: Sequence, late_ms: int) -> Sequence:
    """Return the recording with samples from a time after the first scan on; 0: with all, also those before it."""
    if not late_ms:
        return sequence
    imu, kept = sequence.imu, sequence.imu.stamps_ns >= sequence.stamps_ns[0] + late_ms * 1_000_000
    return replace(sequence, imu=ImuSamples(imu.stamps_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept]))


def first_errors(sequence: Sequence) -> Array:
    """Return of each pose after the first: angle [°], distance [m], and the squared errors of both by covariance."""
    assert sequence.reference is not None
    odometry = Odometry()
    path = trajectory_of([odometry.step(sequence[k]) for k in range(SCANS)])
    assert path.covariances is not None
    truth = se3.between(sequence.reference.poses[0], sequence.reference.poses[:SCANS])
    rows = []
    for error, covariance in zip(se3.log(se3.between(path.poses, truth))[1:], path.covariances[1:], strict=True):
        squared = [error[p] @ np.linalg.solve(covariance[p, p], error[p]) for p in (slice(0, 3), slice(3, 6))]
        rows.append([np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:]), *squared])
    return np.array(rows)


def row(name: str, errors: Array) -> dict[str, str]:
    degrees, metres = np.sqrt((errors[:, :2] ** 2).mean(axis=0))
    rotation, position = errors[:, 2:].mean(axis=0) / 3
    beyond = 100 * (errors[:, 2:] > UNLIKELY).mean(axis=0)
    return {
        "IMU late": name,
        "rotation [°]": f"{degrees:.2f}",
        "position [cm]": f"{100 * metres:.1f}",
        "ANEES rotation": f"{rotation:.2f}",
        "ANEES position": f"{position:.2f}",
        "beyond 12, rotation [%]": f"{beyond[0]:.0f}",
        "beyond 12, position [%]": f"{beyond[1]:.0f}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the recordings")
    parser.add_argument("--kinds", default="campus-handheld,campus-drone", help="scene-platform (default: %(default)s)")
    parser.add_argument("--seeds", default="1,2", help="of the recordings (default: %(default)s)")
    parser.add_argument("--lidar", default="os0", help="of the recordings (default: %(default)s)")
    parser.add_argument("--late-ms", default="0,50,100,150", help="times without samples (default: %(default)s)")
    options = parser.parse_args()
    times = [int(ms) for ms in options.late_ms.split(",")]
    rows = []
    for kind in options.kinds.split(","):
        found = [recording(options.folder, kind, options.lidar, int(seed)) for seed in options.seeds.split(",")]
        for ms in times:
            errors = [first_errors(late(sequence, ms)) for sequence in found]
            rows.append(row(f"{kind}, {ms} ms", np.concatenate(errors)))
    print(tables.to_markdown(rows, ("IMU late",)))


if __name__ == "__main__":
    main()
