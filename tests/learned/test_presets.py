import json
from dataclasses import FrozenInstanceError, replace

import pytest
import torch

from hybridlio.core.errors import ConfigError
from hybridlio.learned.networks.odometry_network import OdometryNetwork, parameter_count
from hybridlio.learned.paper_tables import TABLES, split, table
from hybridlio.learned.presets import PAPER, PRESETS, PUBLISHED, ROWS, preset, row_of
from hybridlio.learned.setting_values import from_dict, to_dict
from hybridlio.learned.settings import LossSettings, NetworkSettings, OptimiserSettings, Recipe
from hybridlio.learned.training.published import published


def test_the_papers_preset_has_the_published_numbers():
    network, loss, optimiser = PAPER.network, PAPER.loss, PAPER.optimiser
    assert (network.geometry.rows, network.geometry.columns, network.imu_samples) == (52, 720, 15)
    assert (loss.alpha, loss.lambda_, loss.matching, loss.kernel) == (1.0, 0.1, "nearest", "l1")
    assert (optimiser.betas, optimiser.weight_decay, optimiser.batch) == ((0.9, 0.99), 1e-5, 20)
    assert (optimiser.learning_rate, optimiser.step_epochs, optimiser.step_factor) == (1e-4, 20, 0.5)


def test_every_row_of_the_comparisons_is_a_preset_and_differs_from_its_neighbours():
    for rows in TABLES.values():
        recipes = [(replace(preset(row.preset), name=""), row.split) for row in rows]
        assert all(a != b for i, a in enumerate(recipes) for b in recipes[:i])
    assert {row.preset for rows in TABLES.values() for row in rows} <= set(PRESETS)


@pytest.mark.parametrize("name", ROWS)
def test_a_row_changes_the_same_settings_of_either_method(name):
    of_paper, of_published = row_of("paper", name), row_of("published", name)
    assert of_paper == preset(name)
    for part in ("network", "loss"):
        method, row, variant = (getattr(recipe, part) for recipe in (PUBLISHED, of_paper, of_published))
        changed = {key for key, value in to_dict(variant).items() if value != to_dict(method)[key]}
        assert all(getattr(variant, key) == getattr(row, key) for key in changed)
        in_paper = {key for key, value in to_dict(row).items() if value != to_dict(getattr(PAPER, part))[key]}
        assert all(getattr(variant, key) == getattr(row, key) for key in in_paper)


def test_a_row_of_an_unknown_method_lists_the_known_ones():
    with pytest.raises(ConfigError, match="paper, published"):
        row_of("default", "mlp")
    with pytest.raises(ConfigError, match="normals-joined"):
        row_of("paper", "attention")


def test_rows_carry_the_names_of_the_published_figures():
    for number, rows in TABLES.items():
        methods = [row.method for row in published(number)]
        ours = [row.published for row in rows]
        assert [name for name in methods if name in ours] == ours
        assert number == 1 or methods == ours


@pytest.mark.parametrize("name", PRESETS)
def test_recipes_round_trip_through_json(name):
    recipe = preset(name)
    assert from_dict(Recipe, json.loads(json.dumps(to_dict(recipe)))) == recipe
    assert recipe.name == name


def test_weights_of_the_papers_network_stay_below_the_size_that_ships():
    with torch.device("meta"):
        assert parameter_count(OdometryNetwork(PAPER.network)) * 4 < 25e6


def test_the_splits_are_the_papers_and_leave_03_out_where_the_imu_is_used():
    assert split("easy", preset("no-imu").network) == (tuple(f"0{n}" for n in range(9)), ("09", "10"))
    train, test = split("hard", PAPER.network)
    assert (train, test) == (("00", "01", "02", "04", "05", "06"), ("07", "08", "09", "10"))
    with pytest.raises(ConfigError, match="easy, hard"):
        split("medium", PAPER.network)


def test_unknown_names_list_the_presets():
    with pytest.raises(ConfigError, match="nubert"):
        preset("newbert")
    with pytest.raises(ConfigError, match="1, 2, 3, 4, 5"):
        table(6)


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"networks": {}}, "networks"),
        ({"network": {"imu_hiden": 3}}, "imu_hiden"),
        ({"network": {"imu": "both"}}, "both"),
        ({"network": {"features": "many"}}, "features"),
        ({"network": {"stages": 3}}, "stages"),
        ({"optimiser": {"batch": 0}}, "batch"),
        ({"optimiser": {"betas": [0.9, 1.0]}}, "betas"),
        ({"loss": 3}, "loss"),
        ({"network": {"geometry": {"rows": 1}}}, "geometry"),
    ],
)
def test_invalid_settings_are_refused_by_name(values, what):
    with pytest.raises(ConfigError, match=what):
        from_dict(Recipe, values)


def test_settings_cannot_be_changed():
    for settings in (NetworkSettings(), LossSettings(), OptimiserSettings(), PAPER):
        with pytest.raises(FrozenInstanceError):
            settings.name = "mine"  # type: ignore[misc]
