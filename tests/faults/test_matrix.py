"""What each fault of sensors, clocks and mounting may do to a run: the promises of docs/reliability.md, kept.

The truth is the simulator's. Whatever the row, nothing is wrong in silence: where more than 2 % of the positions are
off by more than three standard deviations, something is said in the run's notes or the log.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import fault_rows
import faults
import numpy as np
import pytest
from fault_rows import FLAGGED, LONG, REFUSED, SURVIVED

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import notes
from hybridlio.simulation import SimulationConfig, simulate

_THREE_SIGMAS = 14.16  # 99.73 % quantile of χ² with three degrees of freedom
_SILENT_SHARE = 0.02
_GROSS_NEES, _GROSS_SHARE = 25.0, 0.01  # of the scans of all rows together


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


Find = Callable[[str], Outcome]
_ROWS = {**SURVIVED, **FLAGGED, **LONG}
_done: dict[str, Outcome] = {}


@pytest.fixture
def outcome(drive: Sequence, long_drive: Sequence, caplog: pytest.LogCaptureFixture) -> Find:
    """Return a function that runs the odometry on the drive with a row's fault; each once."""

    def find(name: str) -> Outcome:
        if name not in _done:
            caplog.clear()
            row, whole = _ROWS[name], long_drive if name in LONG else drive
            run = run_odometry(row.inject(whole), Odometry())
            assert run.stopped is None
            assert run.done == row.scans
            warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
            added = [line for line in notes(run)[len(whole.notes) :] if "injected fault" not in line]
            _done[name] = Outcome(run, "; ".join([*added, *warnings]))
        return _done[name]

    return find


def errors_m(run: Run) -> np.ndarray:  # type: ignore[type-arg]
    reference = run.sequence.reference
    assert reference is not None
    return np.asarray(run.trajectory.poses[:, :3, 3] - reference.poses[: run.done, :3, 3])


def position_nees(run: Run) -> np.ndarray:  # type: ignore[type-arg]
    """Return the normalised squared error of each position after the first."""
    trajectory = run.trajectory
    assert trajectory.covariances is not None
    R = trajectory.poses[1:, :3, :3]
    covariances = R @ trajectory.covariances[1:, 3:, 3:] @ R.transpose(0, 2, 1)
    off = errors_m(run)[1:]
    return np.asarray(np.einsum("ni,ni->n", off, np.linalg.solve(covariances, off[..., None])[..., 0]))


def off_share(run: Run) -> float:
    """Return the share of the positions after the first that are off by more than three standard deviations."""
    return float(np.mean(position_nees(run) > _THREE_SIGMAS))


@pytest.mark.parametrize("name", [*SURVIVED, *LONG])
def test_a_fault_is_survived_within_its_bound(name: str, outcome: Find) -> None:
    row, found = _ROWS[name], outcome(name)
    assert row.within_m is not None
    assert np.linalg.norm(errors_m(found.run)[:, :2], axis=1).max() < row.within_m
    assert off_share(found.run) <= _SILENT_SHARE
    assert row.said in found.said


@pytest.mark.parametrize("name", FLAGGED)
def test_a_fault_that_is_not_survived_is_flagged(name: str, outcome: Find) -> None:
    assert _ROWS[name].said in outcome(name).said


@pytest.mark.parametrize("name", _ROWS)
def test_nothing_is_wrong_in_silence(name: str, outcome: Find) -> None:
    found = outcome(name)
    share = off_share(found.run)
    assert share <= _SILENT_SHARE or found.said, f"{share:.0%} of the positions are off, and nothing is said"


_COVERED = [name for name in (*FLAGGED, *LONG) if "IMU for 2 s" in name or "scans" in name or "kidnapped" in name]


@pytest.mark.parametrize("name", _COVERED)
def test_covariances_cover_the_error_of_what_was_bridged_or_jumped(name: str, outcome: Find) -> None:
    assert off_share(outcome(name).run) <= _SILENT_SHARE


def test_over_all_faults_together_few_positions_are_far_outside_their_covariance(outcome: Find) -> None:
    as_users_run = [name for name in _ROWS if "--no-check" not in name]
    nees = np.concatenate([position_nees(outcome(name).run) for name in as_users_run])
    assert np.mean(nees > _GROSS_NEES) <= _GROSS_SHARE


@pytest.mark.parametrize("name", REFUSED)
def test_data_that_cannot_be_right_are_refused(name: str, drive: Sequence) -> None:
    fault, message, _ = REFUSED[name]
    with pytest.raises((DataError, ConfigError), match=re.escape(message)):
        fault(drive)


def test_the_documentation_has_the_rows_of_these_tests(project_root: Path) -> None:
    text = (project_root / "docs/reliability.md").read_text()
    assert fault_rows.BEGIN in text
    assert fault_rows.written(text) == text, "run: python tests/helpers/fault_rows.py"


def test_a_run_on_later_stamps_is_the_same(drive: Sequence) -> None:
    part = drive.part(0, 15)
    one, other = (run_odometry(fault(part), Odometry()) for fault in (lambda s: s, faults.shifted(24 * 3600 * 10**9)))
    assert np.abs(one.trajectory.poses - other.trajectory.poses).max() < 1e-9
