import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import (
    load_weights,
    own_tensors,
    put_weights,
    save_weights,
    shipped,
    weights_path,
)


@pytest.mark.parametrize("siamese", ["shared", "twins"])
def test_saved_weights_give_the_same_network_again(rooms, tiny_recipe, tmp_path, siamese):
    recipe = replace(tiny_recipe, network=replace(tiny_recipe.network, siamese=siamese, normalisation="batch"))
    network = OdometryNetwork(recipe.network)
    given = Pairs(rooms[:1], recipe.network).batch([0, 1]).network
    network(given)  # updates running batch statistics
    network.eval()
    save_weights(tmp_path / "w.safetensors", network, recipe, {"data": "room one"})
    found = load_weights(tmp_path / "w.safetensors")
    assert found.recipe == recipe
    assert found.about["data"] == "room one"
    assert torch.equal(found.network()(given).pose, network(given).pose)


def test_asking_twice_asks_again_from_the_first_answer(rooms, tiny_recipe, tmp_path):
    save_weights(tmp_path / "w.safetensors", OdometryNetwork(tiny_recipe.network), tiny_recipe, {})
    once = load_weights(tmp_path / "w.safetensors").asked(1)
    given = Pairs(rooms[:1], tiny_recipe.network).batch([0, 1]).network
    first = once.network().refine(given, torch.eye(4).expand(2, 4, 4)).pose
    twice = once.asked(2).network().refine(given, torch.eye(4).expand(2, 4, 4))
    assert torch.equal(twice.poses[0], first)
    assert torch.equal(twice.pose, once.network().refine(given, first).pose)
    assert once.asked(0).recipe == once.recipe


def test_what_the_weights_are_stands_in_the_files_metadata(tiny_recipe, tmp_path):
    save_weights(tmp_path / "w.safetensors", OdometryNetwork(tiny_recipe.network), tiny_recipe, {"data": "x"})
    with safe_open(str(tmp_path / "w.safetensors"), "pt") as file:
        assert set(file.metadata()) == {"recipe", "hybridlio", "commit", "data"}


def test_shared_parts_are_stored_once(tiny_recipe):
    twins = OdometryNetwork(tiny_recipe.network)
    shared = OdometryNetwork(replace(tiny_recipe.network, siamese="shared"))
    assert len(own_tensors(shared)) < len(own_tensors(twins)) == len(twins.state_dict())


def test_weights_that_do_not_fit_name_what_does_not(tiny_recipe):
    network = OdometryNetwork(tiny_recipe.network)
    tensors = own_tensors(OdometryNetwork(replace(tiny_recipe.network, features=24, imu="none")))
    with pytest.raises(ConfigError) as error:
        put_weights(network, tensors, "w.safetensors")
    assert "imu_network.accel_lstm.weight_ih_l0 is missing" in str(error.value)
    tensors = {**own_tensors(network), "more": torch.zeros(1)}
    tensors["residual_network.translation.bias"] = torch.zeros(4)
    with pytest.raises(ConfigError, match=r"more is unknown; residual_network.translation.bias is \(4,\), .* \(3,\)"):
        put_weights(network, tensors, "w.safetensors")


def test_files_that_are_no_weights_are_named(tmp_path):
    with pytest.raises(DataError, match="absent"):
        load_weights(tmp_path / "absent.safetensors")
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    with pytest.raises(DataError, match="junk"):
        load_weights(tmp_path / "junk.safetensors")
    save_file({"a": torch.zeros(1)}, str(tmp_path / "bare.safetensors"))
    with pytest.raises(DataError, match="no recipe"):
        load_weights(tmp_path / "bare.safetensors")


def test_training_needs_neither_gtsam_nor_open3d_nor_small_gicp(project_root):
    code = (
        "import sys\n"
        "for name in ('gtsam', 'open3d', 'small_gicp', 'pydantic', 'typer', 'filterpy', 'matplotlib'):\n"
        "    sys.modules[name] = None\n"
        "import importlib, pathlib\n"
        "for path in sorted(pathlib.Path('learned').rglob('*.py')):\n"
        "    importlib.import_module('.'.join(['hybridlio', *path.with_suffix('').parts]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1000:]


def test_the_shipped_weights_load_and_are_small():
    path = shipped()
    weights = load_weights(path)
    assert weights.network().settings == weights.recipe.network
    assert sum(file.stat().st_size for file in path.parent.glob("*.safetensors")) <= 25e6
    with pytest.raises(ConfigError, match="default"):
        shipped("nothing")


def test_the_shipped_published_weights_have_no_registration_step():
    network = load_weights(shipped("published")).recipe.network
    assert network.projective_steps == 0
    assert network.iterations == 3
    assert network.encoder
    assert network.imu == "initial-pose"


def test_weights_are_chosen_by_path_by_the_name_of_shipped_ones_or_as_shipped(tmp_path, monkeypatch):
    assert weights_path("shipped") == weights_path("default") == shipped()
    assert weights_path(tmp_path / "mine.safetensors") == tmp_path / "mine.safetensors"
    with pytest.raises(ConfigError, match="choose one of default"):
        weights_path("nothing")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "default").write_bytes(b"")
    assert str(weights_path("default")) == "default"
