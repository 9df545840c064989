"""Find offsets of the IMU's clock that are put into recordings, and measure what correcting them does to odometry.

python benchmarks/clock_offsets.py DATA… [--offsets-ms -150 -50 -10 0 10 50 150] [--exact] [--drift] [--scans 300]

Each recording's IMU stamps are moved by each offset in turn. The table has the offset that was found, its error and
standard deviation, whether it was applied, and the processor time of the check. With `--drift` it also has the absolute
trajectory error of odometry over the first scans, in percent of the path, with the offset uncorrected, corrected, and
without any, and the ratio of the last two; this needs reference poses. With `--exact` it also has the error and the
standard deviation that are left where the reference's turns, all of them and about all axes, take the place of the
lidar's: what the gyroscope's noise and the motion allow.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

import hybridlio as hl
from hybridlio.calibration.clock_offset import find_clock_offset
from hybridlio.calibration.compensation import LARGEST_OFFSET_S
from hybridlio.calibration.imu_check import moved
from hybridlio.calibration.turns import Turns
from hybridlio.runs.recording_check import check_recording, compare_imu, is_comparable
from hybridlio.runs.run import run_odometry

OFFSETS_MS = (-150.0, -50.0, -10.0, 0.0, 10.0, 50.0, 150.0)


def drift_percent(sequence: hl.Sequence, scans: int) -> float:
    """Return the absolute trajectory error of odometry over some scans, in percent of the path's length."""
    part = sequence.part(0, min(scans, len(sequence)))
    run = run_odometry(part, hl.Odometry())
    assert part.reference is not None
    evaluation = hl.evaluate(run.trajectory, part.reference)
    return 100 * evaluation.ate_m / max(part.reference.length_m, 1e-9)


def exact_cells(late: hl.Sequence, offset_ms: float) -> list[str]:
    """Return error and standard deviation of the offset by the reference's turns."""
    assert late.reference is not None
    R = late.calibration.T_imu_lidar[:3, :3]
    found = find_clock_offset(Turns.of(late.reference), late.imu, R, LARGEST_OFFSET_S, late.imu_noise)
    return ["–", "–"] if found is None else [f"{1e3 * found.offset_s + offset_ms:+.2f}", f"{1e3 * found.sigma_s:.2f}"]


def row(sequence: hl.Sequence, offset_ms: float, scans: int | None, exact: bool, right: float | None) -> str:
    """Return a row of the table for one recording with one offset; ``right`` is the drift without any."""
    late = replace(sequence, imu=moved(sequence.imu, 1e-3 * offset_ms))
    begin = time.process_time()
    found = compare_imu(late) if is_comparable(late) else None
    spent = time.process_time() - begin
    cells = [sequence.name, f"{offset_ms:+.0f}"]
    if found is None or found.offset is None:
        cells += ["–", "–", "–", "no"]
    else:
        offset = found.offset
        error_ms = 1e3 * offset.offset_s + offset_ms
        applied = "yes" if offset.is_significant else "no"
        cells += [f"{1e3 * offset.offset_s:+.2f}", f"{error_ms:+.2f}", f"{1e3 * offset.sigma_s:.2f}", applied]
    cells += ["; ".join([*found.doubtful, *found.wrong]) if found is not None else "", f"{spent:.1f}"]
    if exact:
        cells += exact_cells(late, offset_ms)
    if scans is not None and right is not None:
        drifts = [drift_percent(one, scans) for one in (late, check_recording(late))]
        cells += [f"{drift:.4f}" for drift in (*drifts, right)] + [f"{drifts[1] / right:.2f}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+", help="recordings with an IMU whose clock agrees with the lidar's")
    parser.add_argument("--offsets-ms", type=float, nargs="+", default=OFFSETS_MS)
    parser.add_argument("--drift", action="store_true", help="also run odometry (minutes)")
    parser.add_argument("--exact", action="store_true", help="also compare with the reference's turns")
    parser.add_argument("--scans", type=int, default=300, help="of each odometry run (default: %(default)s)")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    heads = ["recording", "offset, ms", "found, ms", "error, ms", "σ, ms", "applied", "doubts", "CPU s"]
    heads += ["error, ms, exact turns", "σ, ms, exact turns"] if options.exact else []
    heads += ["ATE % uncorrected", "ATE % corrected", "ATE % right clock", "ratio"] if options.drift else []
    print(f"| {' | '.join(heads)} |\n| {' | '.join(['---'] * len(heads))} |")
    for path in options.data:
        sequence = hl.open_sequence(path)
        scans = options.scans if options.drift else None
        right = drift_percent(sequence, scans) if scans is not None else None
        for offset_ms in options.offsets_ms:
            print(row(sequence, offset_ms, scans, options.exact, right), flush=True)


if __name__ == "__main__":
    main()
