from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import hybridlio as hl
from hybridlio.commands.app import app
from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.graph import PoseGraph
from hybridlio.graph.run.loop_factors import LoopClosures
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.runs import folder as run_folder
from hybridlio.runs.folder import StoredRun
from hybridlio.runs.write import write_smoothed
from hybridlio.smoothing.loops import ClosedLoops, LoopSearch
from hybridlio.smoothing.smoothed import Smoothed


def smoothed_with(drive: Any, search: LoopSearch, robust: str | None = None) -> Smoothed:
    group = LoopClosures(search, drive.record.calibration.T_imu_lidar)
    return hl.smooth(drive.record, groups=[group], robust=robust)


@pytest.fixture(scope="module")
def smoothed(round_trip: Any) -> Smoothed:
    return hl.smooth(round_trip.record, loops=True)


def test_loops_remove_most_of_the_drift(round_trip: Any, smoothed: Smoothed):
    before = hl.evaluate(hl.smooth(round_trip.record).trajectory, round_trip.truth)
    after = hl.evaluate(smoothed.trajectory, round_trip.truth)
    assert before.ate_m > 0.5
    assert after.ate_m < 0.3 * before.ate_m


def test_loops_reduce_the_covariances_of_positions(round_trip: Any, smoothed: Smoothed):
    alone = hl.smooth(round_trip.record).trajectory.covariances
    assert alone is not None
    assert smoothed.trajectory.covariances is not None
    traces = [np.trace(c[300:, 3:, 3:], axis1=1, axis2=2).mean() for c in (alone, smoothed.trajectory.covariances)]
    assert traces[1] < 0.2 * traces[0]


def test_every_candidate_is_kept_or_listed_as_rejected(smoothed: Smoothed):
    closed: ClosedLoops = smoothed.found["loops"]
    assert closed.search.candidates == len(closed.kept) + len(closed.rejected)
    assert closed.summary() == (
        f"{closed.search.candidates} candidates, {closed.search.verified} verified, "
        f"{len(closed.search.loops)} consistent, {len(closed.kept)} kept"
    )
    plain = json.loads(json.dumps(closed.to_json_dict(first=7)))
    assert plain["kept"] == len(closed.kept) == len(plain["scans"])
    assert plain["scans"][0] == [7 + closed.kept[0].earlier, 7 + closed.kept[0].later]
    assert sum(plain["rejected_by_stage"].values()) == len(plain["rejected"]) == len(closed.rejected)
    assert all(one["reason"] and one["later"] >= 7 for one in plain["rejected"])


@pytest.mark.parametrize("robust", [None, "gnc"])
def test_a_false_loop_is_rejected_in_the_solve(
    round_trip: Any, closed_round_trip: LoopSearch, smoothed: Smoothed, robust: str | None
):
    loops = list(closed_round_trip.loops)
    for k in (3, 17):
        loops[k] = replace(loops[k], pose=loops[k].pose @ se3.exp(np.array([0, 0, 0.1, 5.0, -2.0, 0])))
    with_false_loops = smoothed_with(round_trip, replace(closed_round_trip, loops=tuple(loops)), robust)
    closed: ClosedLoops = with_false_loops.found["loops"]
    solve = {(one.earlier, one.later) for one in closed.rejected if one.stage == "solve"}
    assert solve >= {(loops[k].earlier, loops[k].later) for k in (3, 17)}
    good = hl.evaluate(smoothed.trajectory, round_trip.truth).ate_m
    assert hl.evaluate(with_false_loops.trajectory, round_trip.truth).ate_m < 1.5 * good


def test_loops_are_between_lidars_for_any_mount_of_the_imu(round_trip: Any, closed_round_trip: LoopSearch):
    T_imu_lidar = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, -0.4, 0.8]))
    calibration = replace(round_trip.record.calibration, T_imu_lidar=T_imu_lidar)
    moved = replace(round_trip, record=replace(round_trip.record, calibration=calibration))
    here, there = smoothed_with(round_trip, closed_round_trip), smoothed_with(moved, closed_round_trip)
    np.testing.assert_allclose(there.trajectory.poses, here.trajectory.poses, atol=2e-3)


def test_a_smoothed_run_has_its_loops_in_graph_metrics_and_report(round_trip: Any, smoothed: Smoothed, tmp_path: Path):
    stored = StoredRun(
        tmp_path, round_trip.record.online, np.empty(0, np.int64), None, round_trip.truth,
        {"sequence": "round trip", "notes": []},
    )  # fmt: skip
    write_smoothed(tmp_path / "smoothed", stored, round_trip.record, smoothed)
    kept = smoothed.found["loops"].kept
    graph = PoseGraph.load(tmp_path / "smoothed" / run_folder.GRAPH)
    assert len(graph.factors) == len(round_trip.record.relative) + len(kept)
    metrics = json.loads((tmp_path / "smoothed" / run_folder.METRICS).read_text())
    assert metrics["loops"]["kept"] == len(kept)
    report = (tmp_path / "smoothed" / run_folder.REPORT).read_text()
    assert smoothed.found["loops"].summary() in report


def test_the_command_smooths_a_finished_run_with_loops(tiny_drive: Path, tmp_path: Path):
    run = tmp_path / "run"
    done = CliRunner().invoke(app, ["odometry", str(tiny_drive), "-o", str(run)])
    assert done.exit_code == 0, done.output
    assert len(LoopKeyframes.load(run / run_folder.KEYFRAMES)) >= 4
    done = CliRunner().invoke(app, ["smooth", str(run), "--loops"])
    assert done.exit_code == 0, done.output
    assert "loops: 0 candidates, 0 verified, 0 consistent, 0 kept" in done.output
    assert json.loads((run / "smoothed" / run_folder.METRICS).read_text())["loops"]["kept"] == 0
    (run / run_folder.KEYFRAMES).unlink()
    done = CliRunner().invoke(app, ["smooth", str(run), "--loops"])
    assert done.exit_code == 2
    assert "no keyframes" in done.output
    assert CliRunner().invoke(app, ["smooth", str(run)]).exit_code == 0


def test_a_record_from_python_has_keyframes(tiny_drive: Path):
    odometry = hl.Odometry()
    for frame in hl.open_sequence(tiny_drive):
        odometry.step(frame)
    record = odometry.record()
    assert record.keyframes is not None
    assert (np.diff(record.keyframes.rows) >= 3).all()
    assert hl.smooth(record, loops=True).found["loops"].kept == ()
    with pytest.raises(DataError, match="keyframes"):
        hl.smooth(replace(record, keyframes=None), loops=True)
