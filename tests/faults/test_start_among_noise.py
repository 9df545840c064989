"""A moving start among noise, in an open field of which 16 beams see rings of ground with gaps between."""

from __future__ import annotations

from pathlib import Path

import faults
import numpy as np
import pytest
from fault_rows import Row
from fault_runs import run_row

from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation import SimulationConfig, simulate

_SCANS = 13


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    settings = SimulationConfig(seconds=1.4, seed=161, lidar="16-beam")
    return open_sequence(simulate(Path(tmp_path_factory.mktemp("field")), settings))


@pytest.mark.parametrize(
    "fault",
    [lambda sequence: sequence, faults.ghosts(0.2), faults.random_points(0.3)],
    ids=["none", "ghosts", "random"],
)
def test_a_start_is_found_where_a_scan_covers_half_of_the_next_one_at_most(
    fault: faults.Fault, field: Sequence
) -> None:
    found = run_row(Row(fault, scans=_SCANS), field)
    assert found.largest_m < 0.3
    assert "bridged" not in found.said
    assert np.mean(found.nees) < 15
