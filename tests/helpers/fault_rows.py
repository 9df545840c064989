"""The fault matrix: each fault, what is promised, and the tables of docs/reliability.md that are made of both.

python tests/helpers/fault_rows.py     # write the tables into docs/reliability.md
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import faults
import numpy as np

from hybridlio.core import se3
from hybridlio.datasets.registry import without_false_samples
from hybridlio.datasets.sequence import Sequence
from hybridlio.runs.recording_check import check_recording

_DAY_NS = 24 * 3600 * 10**9
_AXES = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Row:
    """A fault, and what is promised.

    Attributes:
        fault: puts it into the drive.
        promise: for the documentation, behind the bound.
        within_m: largest error of a position, horizontally; None promises only that the fault is flagged.
        said: what the notes or the log contain; empty where nothing need be said.
        scans: number of scans used, from the first on; a fault that stays shows early.
        checked: whether the check before a run looks at the recording first, as the command line has it by default.
    """

    fault: faults.Fault
    promise: str = ""
    within_m: float | None = None
    said: str = ""
    scans: int = 80
    checked: bool = False

    def inject(self, drive: Sequence) -> Sequence:
        """Return the drive with the fault, as a reader and the check give it to a run."""
        found = without_false_samples(self.fault(drive))
        return (check_recording(found) if self.checked else found).part(0, self.scans)


def _survived(fault: faults.Fault, within_m: float, said: str = "", promise: str = "", checked: bool = False) -> Row:
    return Row(fault, promise, within_m, said, checked=checked)


_SWAPPED, _INVERTED = faults.extrinsics(lambda T: T @ _AXES), faults.extrinsics(se3.inverse)
_DEGREES, _IN_G = faults.scaled(gyro=57.3), faults.scaled(accel=1 / 9.81)

SURVIVED = {
    "no fault": _survived(lambda sequence: sequence, 0.1),
    "no scans for 2 s": _survived(
        faults.no_scans(3, 5), 0.2, "unusable scans bridged", "the scans are noted as bridged"
    ),
    "no IMU for 2 s": _survived(faults.no_imu(3, 5), 0.2),
    "neither for 0.5 s": _survived(
        faults.both(faults.no_scans(3, 3.5), faults.no_imu(3, 3.5)), 1.0, "bridged", "the scans are noted as bridged"
    ),
    "IMU frozen for 2 s": _survived(
        faults.frozen(3, 5), 0.2, "a repeated sample fills", "its samples are left out, with a note"
    ),
    "IMU late by 100 ms": _survived(
        faults.late(0.1), 0.2, "the IMU's clock differs", "the check before a run moves its stamps", checked=True
    ),
    "IMU late by 100 ms, `--no-check`": _survived(faults.late(0.1), 0.2),
    "stamps of the IMU jitter by 5 ms": _survived(faults.jittered(0.005), 0.2),
    "IMU saturated at 9 degrees a second": _survived(faults.clipped(0.15, 9.9), 0.2),
    "IMU at 10 Hz": _survived(faults.rate(10), 0.2),
    "two scans in each other's place": _survived(faults.swapped(40), 0.2, "2 scans rejected", "both are rejected"),
    "two unreadable scans": _survived(
        faults.unreadable(40, 41), 0.2, "frame 40: the file is cut off", "noted, with the reason"
    ),
    "half of each scan missing for 2 s": _survived(faults.half_missing(3, 5), 0.2),
    "a tenth of the points random": _survived(faults.random_points(0.1), 0.3),
    "30 % of the points random": _survived(faults.random_points(0.3), 0.3),
    "a fifth of the points as ghosts": _survived(faults.ghosts(0.2), 0.2),
    "rain on a fifth of the rays": _survived(faults.rain(0.2), 0.2),
    "a pane of glass beside the lidar": _survived(faults.glass(2.0, 0.5), 0.2),
    "extrinsics turned by 5 degrees": _survived(
        faults.turned_by(5), 0.2, "as if T_imu_lidar were 5.0° off", "the notes name the angle and its axes"
    ),
    "lidar upside down": _survived(faults.upside_down, 0.2, promise="with the right extrinsics"),
    "gyroscope in degrees a second": _survived(
        _DEGREES, 0.2, "converted to rad/s", "the check before a run converts it", checked=True
    ),
    "acceleration in g": _survived(_IN_G, 0.2, "converted to m/s²", "the check before a run converts it", checked=True),
    "stamps a day later": _survived(faults.shifted(_DAY_NS), 0.1, promise="the same poses"),
    "stamps near the end of int64": _survived(faults.shifted(7 * 10**18), 0.1),
}
FLAGGED = {
    "neither scans nor IMU for 2 s": Row(
        faults.both(faults.no_scans(3, 5), faults.no_imu(3, 5)),
        "scans are bridged, and a new map begins where the place is not found again; the covariances cover the error",
        None,
        "bridged",
    ),
    "scans jump to another place": Row(
        faults.rearranged(lambda k: k if k < 40 else k + 20),
        "scans conflict with the IMU; the jump is not in the trajectory, and the covariances grow by the path since",
        None,
        "conflict with the IMU",
        scans=60,
    ),
    "kidnapped: carried to another place": Row(
        faults.carried(40, 20),
        "the covariances grow by the path until both agree again, relative to the positions before; a warning says so",
        None,
        "positions from here on may be off by",
        scans=60,
    ),
    "extrinsics turned by 10 degrees": Row(
        faults.turned_by(10),
        "the notes name the angle and its axes; up to a tenth of the positions are off by more than stated",
        None,
        "as if T_imu_lidar were 9.7° off",
    ),
    "extrinsics inverted": Row(
        _INVERTED, "scans are left out, with the IMU, as either may be wrong", None, "check T_imu_lidar"
    ),
    "extrinsics with swapped axes, `--no-check`": Row(
        _SWAPPED, "many scans conflict with the IMU: check T_imu_lidar, units and clock", None, "check T_imu_lidar"
    ),
    "gyroscope in degrees a second, `--no-check`": Row(_DEGREES, "scans are bridged", None, "bridged", scans=12),
    "acceleration in g, `--no-check`": Row(
        _IN_G, "scans are left out, with the IMU, as either may be wrong", None, "check T_imu_lidar"
    ),
}
# Of another drive, 14 seconds with GPS.
LONG = {
    "no scans for 10 s": Row(
        faults.no_scans(2, 12),
        "noted; the covariances cover the error, and a new map begins",
        4.0,
        "unusable scans bridged",
        scans=140,
    ),
    "no IMU for 10 s": Row(faults.no_imu(2, 12), "", 0.2, scans=140),
}
REFUSED: dict[str, tuple[Callable[[Sequence], Sequence], str, str]] = {
    "repeated stamps of the IMU": (
        faults.repeated_stamps,
        "time does not increase at row 50",
        "time does not increase, with the row; readers of files drop or merge such rows with a note",
    ),
    "a clock that steps back": (
        faults.clock_step,
        "scan stamps do not increase at scan 40",
        "scan stamps do not increase, with the scan",
    ),
    "extrinsics with swapped axes": (
        Row(_SWAPPED, checked=True).inject,
        "the IMU's axes are swapped or turned: its x, y, z should be y, x, -z",
        "the check before a run names the axes, and prints the calibration to write",
    ),
}


def tables() -> str:
    """Return the counts and the tables for the documentation."""
    survived = {**SURVIVED, **LONG}
    bounds = {name: "; ".join(filter(None, (f"{row.within_m:g} m", row.promise))) for name, row in survived.items()}
    counts = f"Of these faults, {len(survived)} are survived, {len(FLAGGED)} flagged, {len(REFUSED)} refused."
    return "\n\n".join(
        [
            counts,
            _table("survived", "largest horizontal error", bounds),
            _table("not survived", "what is said", {name: row.promise for name, row in FLAGGED.items()}),
            _table("refused", "message", {name: promise for name, (_, _, promise) in REFUSED.items()}),
        ]
    )


def _table(first: str, second: str, rows: dict[str, str]) -> str:
    lines = [f"| {first} | {second} |", "| --- | --- |", *(f"| {name} | {text} |" for name, text in rows.items())]
    return "\n".join(lines)


BEGIN, END = "<!-- made by tests/helpers/fault_rows.py -->\n\n", "\n\n<!-- end -->"


def written(text: str) -> str:
    """Return a page with the tables as they should be."""
    return re.sub(f"{BEGIN}.*?{END}", lambda _: f"{BEGIN}{tables()}{END}", text, flags=re.DOTALL)


if __name__ == "__main__":
    page = Path(__file__).resolve().parents[2] / "docs/reliability.md"
    page.write_text(written(page.read_text()))
