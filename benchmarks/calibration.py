"""Calibrate recordings from a wrong start: ``python benchmarks/calibration.py DRIVE… [--frames A:B] [--offset-ms T]``.

The mounting is turned by about 2° and moved by about 5 cm, and the stamps of the IMU are moved. The truth is what the
recording states, such as a simulated one. NEES is divided by the number of components: 1 is consistent.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import open_part

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.sequence import Sequence

_TURN_RAD, _SHIFT_M = np.deg2rad(2) / np.sqrt(3), 0.03  # standard deviations of each component


def misplaced(sequence: Sequence, offset_s: float, seed: int) -> Sequence:
    """Return the recording with another mounting, and with stamps that need ``offset_s`` added."""
    rng, T, imu = np.random.default_rng(seed), sequence.calibration.T_imu_lidar, sequence.imu
    R = T[:3, :3] @ se3.so3_exp(_TURN_RAD * rng.standard_normal(3))
    wrong = replace(sequence.calibration, T_imu_lidar=se3.make(R, T[:3, 3] + _SHIFT_M * rng.standard_normal(3)))
    moved = ImuSamples(imu.stamps_ns - round(offset_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)
    return replace(sequence, imu=moved, calibration=wrong, imu_time_offset_s=0.0)


def run(sequence: Sequence, offset_s: float, seed: int) -> None:
    true, begin = sequence.calibration.T_imu_lidar, time.process_time()
    found = hl.calibrate(misplaced(sequence, offset_s, seed))
    T = found.calibration.T_imu_lidar
    errors = {
        "time_offset": np.array([found.imu_time_offset_s - offset_s]),
        "rotation": se3.so3_log(T[:3, :3].T @ true[:3, :3]),
        "translation": T[:3, 3] - true[:3, 3],
    }
    nees = {name: _nees(error, found.parameter(name).covariance) for name, error in errors.items()}
    time_ms, sigma_ms = 1e3 * errors["time_offset"][0], 1e3 * found.parameter("time_offset").sigmas[0]
    angle, distance = (float(np.linalg.norm(errors[name])) for name in ("rotation", "translation"))
    print(
        f"{sequence.name:36s} {time_ms:+8.3f} {sigma_ms:7.3f} {np.rad2deg(angle):7.3f} {100 * distance:7.2f} "
        f"{nees['time_offset']:7.2f} {nees['rotation']:7.2f} {nees['translation']:7.2f} "
        f"{time.process_time() - begin:6.0f}",
        flush=True,
    )


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, metavar="DRIVE")
    parser.add_argument("--frames", metavar="A:B", help="use only some of the scans")
    parser.add_argument("--offset-ms", type=float, default=15.0, help="to be found (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the wrong mounting (default: %(default)s)")
    options = parser.parse_args()
    print(
        f"{'':36s} {'time ms':>8s} {'± ms':>7s} {'rot °':>7s} {'pos cm':>7s} {'NEES: t':>7s} {'rot':>7s} {'pos':>7s} "
        f"{'CPU s':>6s}"
    )
    for path in options.drives:
        run(open_part(path, None, options.frames), options.offset_ms / 1e3, options.seed)


if __name__ == "__main__":
    main()
