import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.paper_tables import TABLES
from hybridlio.learned.presets import PRESETS
from hybridlio.learned.training.ablation import RowData, reduced, run_rows, spread_over
from hybridlio.learned.training.ablation_results import RowResult
from hybridlio.learned.training.driving import drift_of, drive
from hybridlio.learned.training.run_options import RunOptions

CPU = RunOptions(device="cpu")


def test_driving_feeds_back_the_estimated_velocity(winding, tiny_recipe):
    settings = replace(tiny_recipe.network, velocity=True, residual_scale=1e-6)
    torch.manual_seed(0)
    network = OdometryNetwork(settings)
    torch.nn.init.zeros_(network.imu_network.translation.weight)
    driven = drive(network, winding)
    assert len(driven.poses) == len(Pairs([winding], settings)) == 11
    assert driven.initial[0, :3, 3] == pytest.approx([0.5, 0, 0], abs=1e-5)
    for before, initial in zip(driven.poses[:-1], driven.initial[1:], strict=True):
        assert initial[:3, 3] == pytest.approx(before[:3, :3].T @ before[:3, 3], abs=1e-5)
    assert np.allclose(driven.reference, winding.reference[1:], atol=1e-6)


def test_only_the_first_velocity_need_be_known(winding, tiny_recipe):
    network = OdometryNetwork(replace(tiny_recipe.network, velocity=True))
    whole = drive(network, winding)
    winding.velocity_m_s = winding.velocity_m_s.copy()
    winding.velocity_m_s[4:7] = np.nan
    assert np.array_equal(drive(network, winding).poses, whole.poses)
    winding.velocity_m_s[1] = np.nan
    assert len(drive(network, winding).poses) == len(whole.poses) - 1


def test_a_gap_between_steps_is_refused_by_its_scan(rooms, tiny_recipe):
    settings = replace(tiny_recipe.network)
    shard = rooms[0]
    shard.usable = shard.usable.copy()
    shard.usable[5] = False
    with pytest.raises(DataError, match="scan 5"):
        drive(OdometryNetwork(settings), shard)


def test_drift_of_steps_that_are_one_percent_long_is_one_percent():
    reference = np.tile(se3.exp([0, 0, 0, 1.0, 0, 0]), (150, 1, 1))
    poses = np.tile(se3.exp([0, 0, 0, 1.01, 0, 0]), (150, 1, 1))
    assert drift_of(poses, reference) == pytest.approx((1.0, 0.0), abs=0.02)
    assert drift_of(poses, np.full_like(reference, np.nan)) is None


def test_rows_share_a_budget_and_finished_rows_are_reused(rooms, tiny_recipe, tmp_path):
    rows = [
        replace(tiny_recipe, name="one"),
        replace(tiny_recipe, name="two", loss=replace(tiny_recipe.loss, lambda_=0)),
    ]
    asked, ticks = [], []

    def data(recipe):
        asked.append(recipe.name)
        return RowData(rooms[:1], rooms[1:])

    results = run_rows(rows, data, tmp_path, 6, CPU, lambda recipe, done: ticks.append((recipe.name, done.step)))
    assert [(r.name, r.steps, r.pairs) for r in results] == [("one", 6, 24), ("two", 6, 24)]
    assert ticks == [(name, step) for name in ("one", "two") for step in range(1, 7)]
    assert set(results[0].train) == {"room one"}
    assert set(results[0].test) == {"room two"}
    assert run_rows(rows, data, tmp_path, 6, CPU) == results
    assert asked == ["one", "two"]
    with pytest.raises(ConfigError, match="steps: 6 → 7"):
        run_rows(rows, data, tmp_path, 7, CPU)
    with pytest.raises(ConfigError, match=r"loss\.lambda_"):
        run_rows([replace(rows[1], name="one")], data, tmp_path, 6, CPU)
    with pytest.raises(ConfigError, match="same name"):
        run_rows([rows[0], rows[0]], data, tmp_path, 6, CPU)


def test_an_interrupted_row_resumes_from_its_checkpoint(rooms, tiny_recipe, tmp_path):
    def stop(_, done):
        if done.step == 3:
            raise KeyboardInterrupt

    def data(_):
        return RowData(rooms[:1], rooms[1:])

    with pytest.raises(KeyboardInterrupt):
        run_rows([tiny_recipe], data, tmp_path, 6, CPU, stop)
    run_rows([tiny_recipe], data, tmp_path, 6, CPU)
    lines = [json.loads(line) for line in (tmp_path / "tiny" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [1, 2, 3, 4, 5, 6]


def test_of_many_training_recordings_some_are_driven_spread_over_them():
    assert spread_over(list(range(106)), 8) == [0, 13, 26, 39, 53, 66, 79, 92]
    assert spread_over([1, 2, 3], 8) == [1, 2, 3]


def test_averages_leave_out_what_is_too_short():
    row = RowResult("x", 1, 1, 1.0, {"a": (1.0, 2.0), "b": (3.0, 6.0), "c": None}, {"d": None})
    assert row.train_average == (2.0, 4.0)
    assert row.test_average is None


def test_reduced_rows_differ_where_the_full_ones_do():
    rows = {row.preset for table in TABLES.values() for row in table}
    recipes = [replace(reduced(PRESETS[name]), name="") for name in sorted(rows)]
    assert all(a != b for i, a in enumerate(recipes) for b in recipes[:i])
    assert {recipe.network.geometry for recipe in recipes} == {
        replace(PRESETS["paper"].network.geometry, rows=26, columns=180)
    }
