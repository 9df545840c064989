"""`hybridlio ablate`: trains rows with the same number of steps, shows published results beside them, and resumes."""

import json

import pytest
from typer.testing import CliRunner

import hybridlio.learned.training.ablation as ablation
from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.commands.app import app
from hybridlio.core.errors import EstimationError


def run(*words):
    return CliRunner().invoke(app, ["ablate", *map(str, words)])


@pytest.fixture
def tiny(monkeypatch):
    """Use maps and encoders that train within a second."""
    reduced = ablation.reduced
    cells = MapGeometry(15.0, -15.0, 16, 90)
    monkeypatch.setattr(ablation, "reduced", lambda recipe: reduced(recipe, cells, batch=2))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("shards")


def test_rows_are_trained_once_and_shown_beside_published_results(tiny_drive, tiny, cache, tmp_path):
    words = (
        tiny_drive,
        "--table",
        2,
        "--test",
        tiny_drive,
        "--steps",
        2,
        "--reduced",
        "-o",
        tmp_path,
        "--cache",
        cache,
    )
    done = run(*words)
    assert done.exit_code == 0, done.output
    for name in ("paper", "imu-feature", "no-imu"):
        assert f"measured ({name})" in done.output
    assert "2.03 / 1.14" in done.output
    output = json.loads((tmp_path / "table-2.json").read_text())
    assert [[seed["steps"] for seed in line["results"]] for line in output["lines"]] == [[2], [2], [2]]
    assert "2 steps per row, reduced size" in (tmp_path / "table-2.md").read_text()
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/result.json")}
    assert len(stamps) == 3
    again = run(tiny_drive, *words)
    assert again.exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps


def test_a_row_that_fails_does_not_stop_the_others(tiny_drive, tiny, cache, tmp_path, monkeypatch):
    train = ablation.train

    def failing(recipe, *args, **kwargs):
        if recipe.name == "imu-feature":
            raise EstimationError("training diverged at step 1")
        return train(recipe, *args, **kwargs)

    monkeypatch.setattr(ablation, "train", failing)
    words = ("--table", 2, "--test", tiny_drive, "--steps", 1, "--reduced", "-o", tmp_path, "--cache", cache)
    done = run(tiny_drive, *words)
    assert done.exit_code == 1
    assert "error: imu-feature: training diverged at step 1" in done.output
    output = json.loads((tmp_path / "table-2.json").read_text())
    assert [line["results"] == [] for line in output["lines"]] == [False, True, False]


def test_table_1_has_rows_of_earlier_methods_and_published_results_of_methods_without_preset(
    tiny_drive, tiny, cache, tmp_path
):
    words = ("--table", 1, "--test", tiny_drive, "--steps", 1, "--reduced", "--rows", "cho,nubert", "-o", tmp_path)
    done = run(tiny_drive, *words, "--cache", cache)
    assert done.exit_code == 0, done.output
    output = {line["method"]: line for line in json.loads((tmp_path / "table-1.json").read_text())["lines"]}
    assert output["Cho et al."]["preset"] == "cho"
    assert output["Nubert et al."]["results"][0]["steps"] == 1
    assert output["LOAM(w/ map)"]["preset"] is None
    assert output["SelfVoxeLO"]["published"]["t_rel_percent"]["09"] == 3.01


def test_seeds_get_folders_of_their_own_and_rows_are_variants_of_the_base(tiny_drive, tiny, cache, tmp_path):
    words = ("--table", 4, "--test", tiny_drive, "--steps", 1, "--reduced", "--rows", "mlp", "-o", tmp_path)
    done = run(tiny_drive, *words, "--cache", cache, "--seeds", 2, "--base", "published")
    assert done.exit_code == 0, done.output
    recipes = [json.loads((tmp_path / f"mlp-seed-{seed}" / "recipe.json").read_text()) for seed in (0, 1)]
    assert [recipe["optimiser"]["seed"] for recipe in recipes] == [0, 1]
    assert {(recipe["network"]["head"], recipe["network"]["distance"]) for recipe in recipes} == {("mlp", "gradient")}
    assert "1 steps per row, 2 seeds, variants of published, reduced size" in (tmp_path / "table-4.md").read_text()
    results = {line["preset"]: line["results"] for line in json.loads((tmp_path / "table-4.json").read_text())["lines"]}
    assert [seed["name"] for seed in results["mlp"]] == ["mlp-seed-0", "mlp-seed-1"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--table", 7, "--test", "x"), "table 7"),
        (("--table", 2), "--test"),
        (("--table", 2, "--test", "x", "--split", "easy"), "--split"),
        (("--table", 2, "--test", "x", "--rows", "attention"), "imu-feature"),
        (("--table", 2, "--split", "middling"), "easy, hard"),
        (("--table", 2, "--test", "x", "--base", "default"), "paper, published"),
    ],
    ids=str,
)
def test_the_error_for_invalid_options_names_them(words, named, tiny_drive, tmp_path):
    refused = run(tiny_drive, *words, "-o", tmp_path)
    assert refused.exit_code == 2
    assert named in refused.output
