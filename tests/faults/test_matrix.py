"""What each fault of sensors, clocks and mounting may do to a run: the promises of docs/reliability.md, kept.

The truth is the simulator's. Whatever the row, nothing is wrong in silence: where more than 2 % of the positions are
off by more than three standard deviations, something is said in the run's notes or the log.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import faults
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import notes
from hybridlio.simulation import SimulationConfig, simulate

_THREE_SIGMAS = 14.16  # 99.73 % quantile of χ² with three degrees of freedom
_SILENT_SHARE = 0.02
_DAY_NS = 24 * 3600 * 10**9
_AXES = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Row:
    """A fault, and what is promised.

    Attributes:
        fault: puts it into the drive.
        within_m: largest error of a position, horizontally; None promises only that the fault is flagged.
        said: what the notes or the log contain; empty where nothing need be said.
        scans: number of scans used, from the first on; a fault that stays shows early.
    """

    fault: faults.Fault
    within_m: float | None = None
    said: str = ""
    scans: int = 80


SURVIVED = {
    "no fault": Row(lambda sequence: sequence, 0.1),
    "no scans for 2 s": Row(faults.no_scans(3, 5), 0.2, "unusable scans bridged"),
    "no IMU for 2 s": Row(faults.no_imu(3, 5), 0.2),
    "neither for 0.5 s": Row(faults.both(faults.no_scans(3, 3.5), faults.no_imu(3, 3.5)), 1.0, "bridged"),
    "IMU frozen for 2 s": Row(faults.frozen(3, 5), 0.2),
    "IMU late by 100 ms": Row(faults.late(0.1), 0.2),
    "stamps of the IMU jitter by 5 ms": Row(faults.jittered(0.005), 0.2),
    "IMU saturated at 9 degrees a second": Row(faults.clipped(0.15, 9.9), 0.2),
    "IMU at 10 Hz": Row(faults.rate(10), 0.2),
    "two scans in each other's place": Row(faults.swapped(40), 0.2, "2 scans rejected"),
    "two unreadable scans": Row(faults.unreadable(40, 41), 0.2, "frame 40: the file is cut off"),
    "half of each scan missing for 2 s": Row(faults.half_missing(3, 5), 0.2),
    "a tenth of the points random": Row(faults.random_points(0.1), 0.3),
    "a fifth of the points as ghosts": Row(faults.ghosts(0.2), 0.2),
    "rain on a fifth of the rays": Row(faults.rain(0.2), 0.2),
    "a pane of glass beside the lidar": Row(faults.glass(2.0, 0.5), 0.2),
    "extrinsics turned by 5 degrees": Row(faults.turned_by(5), 0.2, "as if T_imu_lidar were 5.0° off"),
    "lidar upside down": Row(faults.upside_down, 0.2),
    "stamps a day later": Row(faults.shifted(_DAY_NS), 0.1),
    "stamps near the end of int64": Row(faults.shifted(7 * 10**18), 0.1),
}
FLAGGED = {
    "30 % of the points random": Row(faults.random_points(0.3), None, "bridged", scans=8),
    "neither scans nor IMU for 2 s": Row(faults.both(faults.no_scans(3, 5), faults.no_imu(3, 5)), None, "bridged"),
    "kidnapped": Row(faults.rearranged(lambda k: k if k < 40 else k + 20), None, "conflict with the IMU", scans=60),
    "extrinsics with swapped axes": Row(faults.extrinsics(lambda T: T @ _AXES), None, "check T_imu_lidar"),
    "extrinsics turned by 10 degrees": Row(faults.turned_by(10), None, "as if T_imu_lidar were 9.7° off"),
    "extrinsics inverted": Row(faults.extrinsics(se3.inverse), None, "check T_imu_lidar"),
    "gyroscope in degrees a second": Row(faults.scaled(gyro=57.3), None, "bridged", scans=12),
    "acceleration in g": Row(faults.scaled(accel=1 / 9.81), None, "check T_imu_lidar"),
}
REFUSED: dict[str, tuple[Callable[[Sequence], Sequence], str]] = {
    "repeated stamps of the IMU": (faults.repeated_stamps, "time does not increase at row 50"),
    "a clock that steps back": (faults.clock_step, "scan stamps do not increase at scan 40"),
}
# Of another drive, 14 seconds with GPS.
LONG = {
    "no scans for 10 s": Row(faults.no_scans(2, 12), 4.0, "unusable scans bridged", scans=140),
    "no IMU for 10 s": Row(faults.no_imu(2, 12), 0.2, scans=140),
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """Eight seconds through a town with a 16-beam lidar; a seed on which nothing was chosen."""
    settings = SimulationConfig(seconds=8.0, seed=21, lidar="16-beam")
    return open_sequence(simulate(Path(tmp_path_factory.mktemp("faults")), settings))


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    settings = SimulationConfig(seconds=14.0, seed=22, lidar="16-beam", gps=True)
    return open_sequence(simulate(Path(tmp_path_factory.mktemp("long")), settings))


@dataclass(frozen=True)
class Outcome:
    """A run with a fault, and what the run and the log say beside what the drive's own notes say."""

    run: Run
    said: str


@pytest.fixture
def outcome(drive: Sequence, caplog: pytest.LogCaptureFixture) -> Callable[[str, Row], Outcome]:
    """Return a function that runs the odometry on the drive with a fault; each fault once."""

    def find(name: str, row: Row) -> Outcome:
        if name not in _done:
            run = run_odometry(row.fault(drive).part(0, row.scans), Odometry())
            assert run.stopped is None
            assert run.done == row.scans
            warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
            added = [line for line in notes(run)[len(drive.notes) :] if "injected fault" not in line]
            _done[name] = Outcome(run, "; ".join([*added, *warnings]))
        return _done[name]

    return find


_done: dict[str, Outcome] = {}


def errors_m(run: Run) -> np.ndarray:  # type: ignore[type-arg]
    reference = run.sequence.reference
    assert reference is not None
    return np.asarray(run.trajectory.poses[:, :3, 3] - reference.poses[: run.done, :3, 3])


def off_share(run: Run) -> float:
    """Return the share of the positions after the first that are off by more than three standard deviations."""
    trajectory = run.trajectory
    assert trajectory.covariances is not None
    R = trajectory.poses[1:, :3, :3]
    covariances = R @ trajectory.covariances[1:, 3:, 3:] @ R.transpose(0, 2, 1)
    off = errors_m(run)[1:]
    return float(
        np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(covariances, off[..., None])[..., 0]) > _THREE_SIGMAS)
    )


Find = Callable[[str, Row], Outcome]


@pytest.mark.parametrize("name", SURVIVED)
def test_a_fault_is_survived_within_its_bound(name: str, outcome: Find) -> None:
    row = SURVIVED[name]
    found = outcome(name, row)
    assert row.within_m is not None
    assert np.linalg.norm(errors_m(found.run)[:, :2], axis=1).max() < row.within_m
    assert off_share(found.run) <= _SILENT_SHARE
    assert row.said in found.said


@pytest.mark.parametrize("name", FLAGGED)
def test_a_fault_that_is_not_survived_is_flagged(name: str, outcome: Find) -> None:
    row = FLAGGED[name]
    found = outcome(name, row)
    assert row.said in found.said
    share = off_share(found.run)
    assert share <= _SILENT_SHARE or found.said, f"{share:.0%} of the positions are off, and nothing is said"


@pytest.mark.parametrize("name", REFUSED)
def test_data_that_cannot_be_right_are_refused(name: str, drive: Sequence) -> None:
    fault, message = REFUSED[name]
    with pytest.raises((DataError, ConfigError), match=message):
        fault(drive)


@pytest.mark.parametrize("name", LONG)
def test_a_long_fault_is_survived_or_flagged(name: str, long_drive: Sequence) -> None:
    row = LONG[name]
    run = run_odometry(row.fault(long_drive).part(0, row.scans), Odometry())
    said = "; ".join(notes(run)[len(long_drive.notes) :])
    assert row.said in said
    if row.within_m is not None:
        assert np.linalg.norm(errors_m(run)[:, :2], axis=1).max() < row.within_m
    assert off_share(run) <= _SILENT_SHARE or said


def test_the_documentation_lists_and_counts_every_row(project_root: Path) -> None:
    text = (project_root / "docs/reliability.md").read_text()
    counts = f"{len(SURVIVED) + len(LONG)} are survived, {len(FLAGGED)} flagged, {len(REFUSED)} refused"
    assert counts in " ".join(text.split())
    assert [name for name in (*SURVIVED, *FLAGGED, *REFUSED, *LONG) if f"| {name} |" not in text] == []


def test_a_run_on_later_stamps_is_the_same(drive: Sequence) -> None:
    part = drive.part(0, 15)
    one, other = (run_odometry(fault(part), Odometry()) for fault in (lambda s: s, faults.shifted(_DAY_NS)))
    assert np.abs(one.trajectory.poses - other.trajectory.poses).max() < 1e-9
