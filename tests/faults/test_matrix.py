"""What each fault of sensors, clocks and mounting may do to a run: the promises of docs/reliability.md, kept.

The truth is the simulator's. Whatever the row, nothing is wrong in silence: where more than 2 % of the positions are
off by more than three standard deviations, something is said in the run's notes or the log.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import fault_rows
import faults
import numpy as np
import pytest
from fault_rows import FLAGGED, LONG, REFUSED, SURVIVED
from fault_runs import GROSS_NEES, Outcome, run_row

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import run_odometry
from hybridlio.simulation import SimulationConfig, simulate

_SILENT_SHARE = 0.02
_GROSS_SHARE = 0.01  # of the scans of all rows together


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """Eight seconds through a town with a 16-beam lidar; a seed on which nothing was chosen."""
    settings = SimulationConfig(seconds=8.0, seed=21, lidar="16-beam")
    return open_sequence(simulate(Path(tmp_path_factory.mktemp("faults")), settings))


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    settings = SimulationConfig(seconds=14.0, seed=22, lidar="16-beam", gps=True)
    return open_sequence(simulate(Path(tmp_path_factory.mktemp("long")), settings))


Find = Callable[[str], Outcome]
_ROWS = {**SURVIVED, **FLAGGED, **LONG}
_done: dict[str, Outcome] = {}


@pytest.fixture
def outcome(drive: Sequence, long_drive: Sequence) -> Find:
    """Return a function that runs the odometry on the drive with a row's fault; each once."""

    def find(name: str) -> Outcome:
        if name not in _done:
            _done[name] = run_row(_ROWS[name], long_drive if name in LONG else drive)
        return _done[name]

    return find


@pytest.mark.parametrize("name", [*SURVIVED, *LONG])
def test_a_fault_is_survived_within_its_bound(name: str, outcome: Find) -> None:
    row, found = _ROWS[name], outcome(name)
    assert row.within_m is not None
    assert found.largest_m < row.within_m
    assert found.off_share <= _SILENT_SHARE
    assert row.said in found.said


@pytest.mark.parametrize("name", FLAGGED)
def test_a_fault_that_is_not_survived_is_flagged(name: str, outcome: Find) -> None:
    assert _ROWS[name].said in outcome(name).said


@pytest.mark.parametrize("name", _ROWS)
def test_nothing_is_wrong_in_silence(name: str, outcome: Find) -> None:
    found = outcome(name)
    share = found.off_share
    assert share <= _SILENT_SHARE or found.said, f"{share:.0%} of the positions are off, and nothing is said"


_COVERED = [name for name in (*FLAGGED, *LONG) if "IMU for 2 s" in name or "scans" in name or "kidnapped" in name]


@pytest.mark.parametrize("name", _COVERED)
def test_covariances_cover_the_error_of_what_was_bridged_or_jumped(name: str, outcome: Find) -> None:
    assert outcome(name).off_share <= _SILENT_SHARE


def test_over_all_faults_together_few_positions_are_far_outside_their_covariance(outcome: Find) -> None:
    as_users_run = [name for name in _ROWS if "--no-check" not in name]
    nees = np.concatenate([outcome(name).nees for name in as_users_run])
    assert np.mean(nees > GROSS_NEES) <= _GROSS_SHARE


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
