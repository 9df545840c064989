"""`hybridlio train`: training, resuming, adaptation and errors."""

import json

import pytest
import yaml
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.learned.networks.weights import load_weights
from hybridlio.learned.training.training_log import read_log
from hybridlio.runs.training import simulated_data

SMALL = {
    "network": {
        "geometry": "16-beam", "siamese": "twins", "normalisation": "group", "velocity": True, "projective_steps": 2,
        "imu_hidden": 8, "imu_layers": 1, "stem": 8, "stages": [8], "blocks": 1, "features": 8,
    },
    "loss": {"reduction": "mean"},
    "optimiser": {"batch": 8, "learning_rate": 1e-3},
}  # fmt: skip


def run(*words):
    return CliRunner().invoke(app, ["train", *map(str, words)])


def ok(*words) -> str:
    done = run(*words)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("shards")


@pytest.fixture(scope="module")
def trained(tiny_drive, recipe, cache, tmp_path_factory):
    """Return the folder of a run of two epochs, its common options, and its output."""
    folder = tmp_path_factory.mktemp("run")
    common = ("--preset", "paper", "--config", recipe, "--cache", cache)
    output = ok(tiny_drive, *common, "--epochs", 2, "--validate", tiny_drive, "-o", folder)
    return folder, common, output


def test_training_writes_weights_with_recipe_data_and_log(trained):
    folder, _, output = trained
    weights = load_weights(folder / "weights.safetensors")
    assert weights.recipe.network.stages == (8,)
    assert weights.recipe.optimiser.epochs == 2
    assert weights.recipe.loss.lambda_ == 0.1  # the preset's value, which the file does not change
    assert "2026_01_01_drive_0003" in weights.about["data"]
    assert weights.about["steps"] == "6"
    assert "23 pairs" in output
    assert output.count("validation loss") == 2
    assert str(folder / "weights.safetensors") in output
    assert len([row for row in read_log(folder / "log.jsonl") if "loss" in row]) == 6


def test_tensorboard_reads_the_log(trained):
    from tensorboardX.proto.event_pb2 import Event

    (file,) = (trained[0] / "tensorboard").glob("events.out.tfevents.*")
    data, found = file.read_bytes(), {}
    while data:  # each record: length, its checksum, event, its checksum
        size = int.from_bytes(data[:8], "little")
        event = Event.FromString(data[12 : 12 + size])
        found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
        data = data[16 + size :]
    rows = [row for row in read_log(trained[0] / "log.jsonl") if "loss" in row]
    assert [found["loss", row["step"]] for row in rows] == pytest.approx([row["loss"] for row in rows])
    assert ("validation/translation_rms_m", 6) in found


def test_the_same_command_resumes_and_gives_the_same_result(tiny_drive, trained, tmp_path):
    _, common, _ = trained
    ok(tiny_drive, *common, "--epochs", 2, "-o", tmp_path / "a")
    once = read_log(tmp_path / "a" / "log.jsonl")
    ok(tiny_drive, *common, "--epochs", 2, "-o", tmp_path / "a")  # finished, so that nothing is done
    assert read_log(tmp_path / "a" / "log.jsonl") == once
    refused = run(tiny_drive, *common, "--epochs", 3, "-o", tmp_path / "a")
    assert refused.exit_code == 2
    assert "optimiser.epochs: 2 → 3" in refused.output
    ok(tiny_drive, *common, "--steps", 4, "-o", tmp_path / "a", "--overwrite")
    assert load_weights(tmp_path / "a" / "weights.safetensors").about["steps"] == "4"


def test_weights_can_be_adapted_and_record_their_origin(tiny_drive, trained, cache, tmp_path):
    path = trained[0] / "weights.safetensors"
    ok(tiny_drive, "--init-from", path, "--cache", cache, "--epochs", 1, "-o", tmp_path / "b")
    before, after = load_weights(path), load_weights(tmp_path / "b" / "weights.safetensors")
    assert after.recipe.network == before.recipe.network
    assert after.recipe.optimiser.learning_rate == pytest.approx(before.recipe.optimiser.learning_rate / 10)
    assert str(path) in after.about["init_from"]
    name = "residual_network.translation.weight"
    moved = (after.tensors[name] - before.tensors[name]).abs().max()
    assert 0 < moved < 0.01


def test_the_initial_pose_option_switches_between_lstm_and_preintegration(tiny_drive, trained, tmp_path):
    _, common, _ = trained
    for name, imu in (("lstm", "initial-pose"), ("preintegration", "given")):
        ok(tiny_drive, *common, "--initial-pose", name, "--steps", 1, "-o", tmp_path / name)
        weights = load_weights(tmp_path / name / "weights.safetensors")
        assert weights.recipe.network.imu == imu
        assert any(key.startswith("imu_network") for key in weights.tensors) == (name == "lstm")
    start = ("--init-from", tmp_path / "lstm" / "weights.safetensors", "--initial-pose", "preintegration")
    ok(tiny_drive, *start, *common[4:], "--steps", 1, "-o", tmp_path / "both")


def test_the_error_for_weights_of_another_shape_names_the_tensor(tiny_drive, trained, tmp_path):
    other = {**SMALL, "network": {**SMALL["network"], "features": 16}}
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    _, common, _ = trained
    words = (*common[:2], "--config", tmp_path / "other.yaml", *common[4:], "--steps", 1)
    refused = run(tiny_drive, *words, "--init-from", trained[0] / "weights.safetensors", "-o", tmp_path / "c")
    assert refused.exit_code == 2
    assert "vertex_encoder.full.weight is (8, 8), the network's is (16, 8)" in refused.output


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--preset", "papr"), "unknown preset 'papr'"),
        (("--steps", "3", "--epochs", "2"), "--epochs"),
        (("--device", "abacus"), "abacus"),
        (("--init-from", "absent.safetensors"), "absent.safetensors"),
        (("--config", "absent.yaml"), "absent.yaml"),
        (("--split", "middling"), "easy, hard"),
    ],
    ids=str,
)
def test_the_error_for_invalid_options_names_them(words, named, tiny_drive, tmp_path):
    refused = run(tiny_drive, "--preset", "paper", "-o", tmp_path, *words)
    assert refused.exit_code == 2
    assert named in refused.output


def test_the_error_for_an_unknown_key_names_it_and_the_file(tiny_drive, tmp_path):
    (tmp_path / "my.yaml").write_text(json.dumps({"network": {"imu_hiden": 3}}))
    refused = run(tiny_drive, "--preset", "paper", "--config", tmp_path / "my.yaml", "-o", tmp_path)
    assert refused.exit_code == 2
    assert "my.yaml" in refused.output
    assert "imu_hiden" in refused.output


def test_simulated_drives_train_and_validate_without_recordings_and_are_kept(recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(simulated_data, "DRIVE_S", 1.0)
    common = ("--simulate", 1, "--lidar", "16-beam", "--preset", "paper", "--config", recipe, "-o", tmp_path / "run")
    ok(*common, "--cache", tmp_path / "drives", "--epochs", 1)
    drives = sorted(path.name for path in (tmp_path / "drives").iterdir() if not path.name.startswith("."))
    assert [name.rsplit("-", 1)[0] for name in drives] == ["simulated-41000", "simulated-45000"]
    assert "simulated-41000" in load_weights(tmp_path / "run" / "weights.safetensors").about["data"]
    assert any("validation/loss" in row for row in read_log(tmp_path / "run" / "log.jsonl"))


def test_the_help_names_every_lidar():
    assert all(name in run("--help").output for name in LIDAR_MODELS)


@pytest.mark.parametrize(
    ("words", "named"), [((), "--simulate"), (("--simulate", 1, "--lidar", "vlp"), "16-beam")], ids=["nothing", "lidar"]
)
def test_what_to_train_on_is_checked_before_anything_is_simulated(words, named, tmp_path):
    refused = run(*words, "-o", tmp_path / "run")
    assert refused.exit_code == 2
    assert named in refused.output
    assert not (tmp_path / "run").exists()
