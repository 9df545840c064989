import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch

from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights
from hybridlio.learned.setting_values import to_dict
from hybridlio.learned.settings import OptimiserSettings
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.feed import Feed
from hybridlio.learned.training.processes import Processes
from hybridlio.learned.training.run_options import RunOptions, Watchers
from hybridlio.learned.training.schedule import epoch_order, learning_rate
from hybridlio.learned.training.train import train
from hybridlio.learned.training.training_log import TrainingLog, read_log
from hybridlio.learned.training.validation import validate

CPU = RunOptions(device="cpu")


def losses(folder):
    return [row["loss"] for row in read_log(folder / "log.jsonl") if "loss" in row]


def validations(folder):
    """Return the rows of the validations, without figures that a short recording lacks."""
    rows = [row for row in read_log(folder / "log.jsonl") if "validation/loss" in row]
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def with_optimiser(recipe, **changes):
    return replace(recipe, optimiser=replace(recipe.optimiser, **changes))


def test_the_loss_falls_and_the_lstms_learn_from_it(rooms, tiny_recipe, tmp_path):
    recipe = with_optimiser(tiny_recipe, epochs=40, learning_rate=4e-3, step_epochs=100)
    pairs = Pairs(rooms[:1], recipe.network)
    torch.manual_seed(recipe.optimiser.seed)
    untrained = OdometryNetwork(recipe.network)
    before = validate(untrained, pairs, recipe)
    network = train(recipe, pairs, tmp_path, validation=pairs, options=replace(CPU, validate_every=40))
    found = losses(tmp_path)
    assert np.mean(found[-8:]) < 0.6 * np.mean(found[:8])
    after = validate(network, pairs, recipe)
    assert after.translation_rms_m < 0.7 * before.translation_rms_m
    assert after.initial_rotation_rms_deg < 0.9 * before.initial_rotation_rms_deg
    rows = [row for row in read_log(tmp_path / "log.jsonl") if "validation/loss" in row]
    assert rows[0]["validation/translation_rms_m"] == pytest.approx(after.translation_rms_m)


def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(rooms, tiny_recipe, tmp_path):
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    whole = train(tiny_recipe, pairs, tmp_path / "whole", options=CPU)
    train(tiny_recipe, pairs, tmp_path / "parts", options=replace(CPU, max_steps=5))
    assert len(losses(tmp_path / "parts")) == 5
    with (tmp_path / "parts" / "log.jsonl").open("a") as log:
        log.write('{"step": 6, "loss": 99.0}\n{"step": 7, "lo')  # as a killed run may leave it
    resumed = train(tiny_recipe, pairs, tmp_path / "parts", options=CPU)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert len(losses(tmp_path / "whole")) == 12
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_are_the_same_whoever_reads_them(rooms, tiny_recipe, tmp_path, workers):
    settings = replace(tiny_recipe.optimiser, initial_noise_m=0.1, mirrored=0.5, points=50)
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    by_thread = list(Feed(pairs, settings).batches(2, 6))
    by_workers = list(Feed(pairs, settings, workers=workers).batches(2, 6))
    assert [indices for indices, _ in by_thread] == [indices for indices, _ in by_workers]
    for (_, a), (_, b) in zip(by_thread, by_workers, strict=True):
        assert torch.equal(a.network.last, b.network.last)
        assert torch.equal(a.network.perturbation, b.network.perturbation)
        assert torch.equal(a.current.points, b.current.points)


def test_figures_read_a_step_late_are_the_same_and_none_is_left_out(rooms, tiny_recipe, tmp_path, monkeypatch):
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    train(tiny_recipe, pairs, tmp_path / "at-once", options=CPU)
    monkeypatch.setattr(Processes, "reads_late", 1)
    steps = []
    watchers = Watchers(lambda progress: steps.append(progress.step))
    train(tiny_recipe, pairs, tmp_path / "late", validation=pairs, options=CPU, watchers=watchers)
    assert losses(tmp_path / "late") == losses(tmp_path / "at-once")
    assert steps == list(range(1, 13))
    late = [row["step"] for row in read_log(tmp_path / "late" / "log.jsonl")]
    assert late == sorted(late)


def test_read_a_step_late_a_diverged_step_still_stays_out_of_checkpoints(rooms, tiny_recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(Processes, "reads_late", 1)
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    train(tiny_recipe, pairs, tmp_path, options=replace(CPU, max_steps=5))
    batch, asked = pairs.batch, []

    def broken_at_the_second(*indices):
        good = batch(*indices)
        asked.append(1)
        factor = torch.nan if len(asked) == 2 else 1.0
        return replace(good, network=replace(good.network, imu=good.network.imu * factor))

    monkeypatch.setattr(pairs, "batch", broken_at_the_second)
    with pytest.raises(EstimationError, match="step 7"):
        train(tiny_recipe, pairs, tmp_path, options=replace(CPU, checkpoint_every=1))
    kept = checkpoints.load(tmp_path / "checkpoint.pt")
    assert kept.step == 6
    assert all(tensor.isfinite().all() for tensor in kept.network.values())


def test_the_log_has_every_term_the_gradient_and_the_time_of_each_step(rooms, tiny_recipe, tmp_path):
    recipe = with_optimiser(tiny_recipe, epochs=1)
    train(recipe, Pairs(rooms[:1], recipe.network), tmp_path, options=CPU)
    rows = read_log(tmp_path / "log.jsonl")
    names = {"step", "loss", "po2pl_m", "pl2pl", "matched", "gradient_norm", "learning_rate", "waited_s", "step_s"}
    assert all(set(row) == names for row in rows)
    assert all(0 < row["matched"] <= 1 and row["gradient_norm"] > 0 for row in rows)
    assert all(0 <= row["waited_s"] <= row["step_s"] for row in rows)


def test_given_initial_poses_get_the_same_perturbation_after_resuming(rooms, tiny_recipe, tmp_path):
    recipe = with_optimiser(
        replace(tiny_recipe, network=replace(tiny_recipe.network, imu="given")), initial_noise_m=0.1, epochs=2
    )
    pairs = Pairs(rooms[:1], recipe.network)
    train(recipe, pairs, tmp_path / "whole", options=CPU)
    train(recipe, pairs, tmp_path / "parts", options=replace(CPU, max_steps=3))
    train(recipe, pairs, tmp_path / "parts", options=CPU)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")


def test_two_processes_agree_with_one_on_the_same_batches(rooms, room_shards, tiny_recipe, tmp_path, project_root):
    # 15 pairs in batches of 4: the last batch has 3, shared unevenly; this loss gives the LSTMs no gradient
    tiny_recipe = replace(tiny_recipe, network=replace(tiny_recipe.network, projective_steps=1))
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    train(tiny_recipe, pairs, tmp_path / "one", validation=pairs, options=CPU)
    script = tmp_path / "run.py"
    script.write_text(
        "import json, sys, torch\n"
        "from hybridlio.learned.data.pairs import Pairs\n"
        "from hybridlio.learned.setting_values import from_dict\n"
        "from hybridlio.learned.settings import Recipe\n"
        "from hybridlio.learned.data.shards import Shard\n"
        "from hybridlio.learned.training.run_options import RunOptions\n"
        "from hybridlio.learned.training.train import train\n"
        "torch.set_num_threads(1)\n"
        "recipe = from_dict(Recipe, json.loads(sys.argv[1]))\n"
        "pairs = Pairs([Shard(sys.argv[2])], recipe.network)\n"
        "train(recipe, pairs, sys.argv[3], validation=pairs, options=RunOptions(device='cpu'))\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)]
    arguments = [json.dumps(to_dict(tiny_recipe)), str(room_shards[0]), str(tmp_path / "two")]
    # the network's interface is the loopback: a test needs no other, and a machine may have none
    environment = {**os.environ, "PYTHONPATH": str(project_root), "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, *arguments], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    assert np.allclose(losses(tmp_path / "two"), losses(tmp_path / "one"), rtol=1e-3)
    one, two = (validations(tmp_path / name) for name in ("one", "two"))
    assert len(one) == 3
    assert all(a == pytest.approx(b, rel=1e-2, abs=1e-4) for a, b in zip(one, two, strict=True))
    weights = [load_weights(tmp_path / name / "weights.safetensors").tensors for name in ("one", "two")]
    assert max(float((weights[0][name] - weights[1][name]).abs().max()) for name in weights[0]) < 1e-3


@pytest.mark.parametrize("step", [0, 5])
def test_a_diverging_run_stops_and_keeps_its_last_good_checkpoint(rooms, tiny_recipe, tmp_path, step, monkeypatch):
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    if step:
        train(tiny_recipe, pairs, tmp_path, options=replace(CPU, max_steps=step))
    batch = pairs.batch

    def broken(*indices):
        good = batch(*indices)
        return replace(good, network=replace(good.network, imu=good.network.imu * torch.nan))

    monkeypatch.setattr(pairs, "batch", broken)
    with pytest.raises(EstimationError, match=rf"step {step + 1} .*room one") as error:
        train(tiny_recipe, pairs, tmp_path, options=CPU)
    assert ("checkpoint.pt" in str(error.value)) == bool(step)
    if step:
        kept = checkpoints.load(tmp_path / "checkpoint.pt")
        assert kept.step == step
        assert all(tensor.isfinite().all() for tensor in kept.network.values())


def test_an_interrupted_run_keeps_what_it_did(rooms, tiny_recipe, tmp_path):
    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tiny_recipe, Pairs(rooms[:1], tiny_recipe.network), tmp_path, options=CPU, watchers=Watchers(stop))
    assert checkpoints.load(tmp_path / "checkpoint.pt").step == 3


def test_a_folder_of_another_run_is_refused_and_what_differs_is_named(rooms, tiny_recipe, tmp_path):
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    train(tiny_recipe, pairs, tmp_path, options=replace(CPU, max_steps=1))
    with pytest.raises(ConfigError, match=r"optimiser.batch: 4 → 2"):
        train(with_optimiser(tiny_recipe, batch=2), pairs, tmp_path, options=CPU)
    with pytest.raises(ConfigError, match=r"pairs: \d+ → \d+"):
        train(tiny_recipe, Pairs(rooms, tiny_recipe.network), tmp_path, options=CPU)


def test_the_weights_that_validate_best_are_kept_beside_the_last(rooms, tiny_recipe, tmp_path):
    pairs, scores = Pairs(rooms[:1], tiny_recipe.network), []
    watchers = Watchers(validated=lambda _step, found: scores.append(found.score))
    train(tiny_recipe, pairs, tmp_path, validation=pairs, options=replace(CPU, max_steps=8), watchers=watchers)
    kept = load_weights(tmp_path / "best.safetensors")
    assert float(kept.about["score"]) == min(scores)
    assert validate(kept.network(), pairs, kept.recipe).score == pytest.approx(min(scores))
    train(tiny_recipe, pairs, tmp_path, validation=pairs, options=CPU, watchers=watchers)
    assert float(load_weights(tmp_path / "best.safetensors").about["score"]) == min(scores)
    assert len(scores) == 3


def test_a_damaged_checkpoint_is_named(rooms, tiny_recipe, tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"PK nothing")
    with pytest.raises(DataError, match=r"checkpoint\.pt"):
        train(tiny_recipe, Pairs(rooms[:1], tiny_recipe.network), tmp_path, options=CPU)


def test_training_starts_from_given_weights(rooms, tiny_recipe, tmp_path):
    pairs = Pairs(rooms[:1], tiny_recipe.network)
    trained = train(tiny_recipe, pairs, tmp_path / "first", options=CPU)
    frozen = with_optimiser(tiny_recipe, learning_rate=1e-12, epochs=1)
    again = train(frozen, pairs, tmp_path / "second", start=trained.state_dict(), options=CPU)
    for a, b in zip(trained.parameters(), again.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_progress_reports_rate_and_remaining_time(rooms, tiny_recipe, tmp_path):
    seen = []
    train(tiny_recipe, Pairs(rooms[:1], tiny_recipe.network), tmp_path, options=CPU, watchers=Watchers(seen.append))
    assert [p.step for p in seen] == list(range(1, 13))
    assert [p.epoch for p in seen] == [0] * 4 + [1] * 4 + [2] * 4
    assert seen[-1].remaining_s == 0
    assert all(p.steps == 12 and p.pairs_per_s > 0 for p in seen)


def test_the_rate_halves_by_steps_or_follows_a_cosine():
    step = OptimiserSettings()
    assert [learning_rate(step, epoch) for epoch in (0, 19.99, 20, 40)] == [1e-4, 1e-4, 5e-5, 2.5e-5]
    cosine = OptimiserSettings(schedule="cosine", epochs=10)
    assert [learning_rate(cosine, epoch) for epoch in (0, 5, 10)] == pytest.approx([1e-4, 5e-5, 0.0])


def test_every_pair_comes_once_an_epoch_in_another_order():
    settings = OptimiserSettings(batch=4)
    first, second = epoch_order(settings, 0, 10), epoch_order(settings, 1, 10)
    assert [len(part) for part in first] == [4, 4, 2]
    assert sorted(chain(*first)) == sorted(chain(*second)) == list(range(10))
    assert first != second
    assert first == epoch_order(settings, 0, 10)


def test_non_finite_values_are_null_in_the_log(tmp_path):
    log = TrainingLog(tmp_path, 0)
    log.write(1, loss=float("nan"), po2pl_m=None)
    log.close()
    assert read_log(tmp_path / "log.jsonl") == [{"step": 1, "loss": None, "po2pl_m": None}]


def test_progress_counts_to_where_the_run_ends_not_its_schedule(rooms, tiny_recipe, tmp_path):
    reports = []
    train(
        tiny_recipe,
        Pairs(rooms[:1], tiny_recipe.network),
        tmp_path,
        options=replace(CPU, max_steps=2),
        watchers=Watchers(reports.append),
    )
    assert [(p.step, p.steps) for p in reports] == [(1, 2), (2, 2)]
    assert reports[-1].remaining_s == 0
