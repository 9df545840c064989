import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError, GraphError
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.compare import (
    Comparison,
    cells,
    combinations,
    compare_configs,
    table,
    to_markdown,
    write_comparison,
)
from hybridlio.runs.run import run_odometry

SOURCES = ("kalman", "constant-velocity")


@pytest.fixture(scope="module")
def sequence(tiny_drive) -> Sequence:
    return open_sequence(tiny_drive).part(0, 12)


@pytest.fixture(scope="module")
def compared(sequence) -> Comparison:
    configs = combinations(SOURCES, ["scan-matching", "none"], ["incremental"], Config())
    return compare_configs(sequence, configs)


def test_every_combination_has_a_row_in_order(compared):
    pairs = [(row.initial_pose, row.residual) for row in compared.rows]
    assert pairs == [(a, b) for a in SOURCES for b in ("scan-matching", "none")]
    assert all(row.scans == 12 and row.error is None for row in compared.rows)


def test_a_row_has_the_values_of_a_single_run(compared, sequence):
    run = run_odometry(sequence, Odometry("kalman", "scan-matching"))
    row = compared.rows[0]
    assert row.path_length_m == pytest.approx(run.trajectory.length_m, rel=1e-6)
    assert row.bridged == len(run.bridged)
    true = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    for errors, poses in ((row.initial, run.initial_poses), (row.final, run.steps.poses)):
        off_m = np.linalg.norm(se3.log(se3.between(poses, true))[:, 3:], axis=1)
        assert errors.median_m == pytest.approx(np.median(off_m), rel=1e-3)
        assert errors.rms_m == pytest.approx(np.sqrt(np.mean(off_m**2)), rel=1e-3)
    assert 0 < row.ms_median <= row.ms_p90


def test_scan_matching_reduces_the_step_error(compared):
    for row in compared.rows:
        if row.residual == "scan-matching":
            assert row.final.median_m < row.initial.median_m


def test_table_and_markdown_show_every_row_without_empty_columns(compared):
    console = Console(width=400)
    with console.capture() as text:
        console.print(table(compared))
    markdown = to_markdown(compared).splitlines()
    for row in cells(compared):
        assert any(all(cell in line for cell in row.values()) for line in text.get().splitlines())
        assert f"| {' | '.join(row.values())} |" in markdown
    assert "backend" not in cells(compared)[0]
    assert "ended early" not in cells(compared)[0]


def test_without_a_reference_path_lengths_and_times_are_compared(sequence):
    bare = replace(sequence, reference=None)
    result = compare_configs(bare, combinations(["identity"], ["none"], ["incremental"], Config()))
    (row,) = cells(result)
    assert {"path [m]", "time [ms]", "bridged"} <= set(row)
    assert "ATE [m]" not in row


def test_a_failed_run_has_a_row_with_the_reason_and_the_others_continue(sequence, monkeypatch):
    from hybridlio.sources.kalman import Kalman

    def fail(self, frame, state):
        raise GraphError(f"frame {frame.index}: no")

    monkeypatch.setattr(Kalman, "predict", fail)
    result = compare_configs(sequence, combinations(SOURCES, ["none"], ["incremental"], Config()))
    assert [row.error for row in result.rows] == ["frame 1: no", None]
    assert cells(result)[0]["ended early"] == "after 1 scan: frame 1: no"
    assert cells(result)[1]["ended early"] == "–"


def test_a_recording_without_usable_scans_has_rows(sequence):
    def load(k):
        raise DataError(f"{k}.bin: truncated")

    broken = replace(sequence, load_scan=load)
    (row,) = compare_configs(broken, combinations(["identity"], ["none"], ["incremental"], Config())).rows
    assert row.scans == 0
    assert "0.bin: truncated" in row.error


def test_an_unknown_source_is_an_error_before_any_run(sequence):
    reports = []
    with pytest.raises(ConfigError, match="guess"):
        compare_configs(
            sequence, combinations(["identity", "guess"], ["none"], ["incremental"], Config()), reports.append
        )
    assert reports == []


def test_progress_is_summed_over_all_runs_and_an_interrupt_ends_the_comparison(sequence):
    reports = []

    def show(name, done, total):
        reports.append((name, done, total))
        if done == 15:
            raise KeyboardInterrupt

    found = compare_configs(sequence, combinations([*SOURCES, "kalman"], ["none"], ["incremental"], Config()), show)
    assert isinstance(found.stopped, KeyboardInterrupt)
    assert [(row.initial_pose, row.scans, row.error) for row in found.rows] == [
        (SOURCES[0], 12, None), (SOURCES[1], 3, "interrupted"),
    ]  # fmt: skip
    assert [done for _, done, _ in reports] == list(range(1, 16))
    assert {total for _, _, total in reports} == {36}
    assert reports[-1][0] == "constant-velocity + none"


def test_the_files_contain_all_metrics(compared, tmp_path):
    write_comparison(tmp_path, compared)
    output = json.loads((tmp_path / "compare.json").read_text())
    assert output["sequence"] == compared.sequence
    for row, expected in zip(output["rows"], compared.rows, strict=True):
        assert row["evaluation"]["ate_m"] == expected.evaluation.ate_m
        assert row["initial"]["median_m"] == expected.initial.median_m
    assert (tmp_path / "compare.md").read_text() == to_markdown(compared)
