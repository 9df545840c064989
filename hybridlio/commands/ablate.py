"""``hybridlio ablate``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import INTERRUPTED, guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.shared.training_process import Device, first_process_progress, is_first_process
from hybridlio.commands.terminal import print_message, print_result, print_table
from hybridlio.core.errors import ConfigError, HybridLioError
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics

if TYPE_CHECKING:
    from rich.table import Table

    from hybridlio.learned.paper_tables import TableRow
    from hybridlio.learned.settings import Recipe
    from hybridlio.learned.training.ablation import RowData
    from hybridlio.learned.training.ablation_results import RowResult
    from hybridlio.learned.training.comparison import Line
    from hybridlio.runs.training.training_data import DataOptions

RunRow = Callable[["TableRow"], "tuple[RowResult, ...]"]

Recordings = Annotated[
    list[Path],
    typer.Argument(metavar="DATA…", help="Recordings, folders of recordings, or shards.", show_default=False),
]
Number = Annotated[
    int, typer.Option("--table", metavar="N", help="The table of the paper to reproduce, 1 to 5.", show_default=False)
]
Tests = Annotated[
    list[Path] | None, typer.Option("--test", metavar="DATA", help="A recording to test on; may be repeated.")
]
Split = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", autocompletion=completion.split, help="Split of KITTI odometry, easy or hard; replaces --test."
    ),
]
Steps = Annotated[int, typer.Option(min=1, help="Optimiser steps per row.")]
Out = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="DIR", help="The folder to write to; default ablation/table-N.")
]
Cache = Annotated[
    Path | None, typer.Option(metavar="DIR", help="The folder for prepared recordings; default: beside -o.")
]
Reduced = Annotated[
    bool, typer.Option("--reduced", help="Use coarser maps and smaller encoders, which train on a CPU in minutes.")
]
Base = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.base,
        help="The method that the rows are variants of: paper, its set-up as printed, or published, the set-up of the "
        "shipped weights, which learns within hours on a CPU.",
    ),
]
Seeds = Annotated[
    int, typer.Option(min=1, metavar="N", help="Train each row with N seeds; the table gives the spread.")
]
Only = Annotated[
    str | None,
    typer.Option("--rows", metavar="A,B,…", autocompletion=completion.preset, help="Only the rows of these presets."),
]


@guarded
@common.with_topic_options
def ablate(
    data: Recordings,
    table: Number,
    test: Tests = None,
    split: Split = None,
    steps: Steps = 2000,
    seeds: Seeds = 1,
    base: Base = "paper",
    reduced: Reduced = False,
    rows: Only = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    out: Out = None,
    cache: Cache = None,
    device: Device = "auto",
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Train and evaluate each row of one of the paper's tables with the same number of steps, and print the table.

    Published results are shown beside them. The same command resumes. A row that fails does not stop the others.
    """
    from hybridlio.datasets.protection import check_output
    from hybridlio.learned.networks.devices import pick_device
    from hybridlio.runs.new_folder import claimed
    from hybridlio.runs.own_files import TRAINING, table_files
    from hybridlio.runs.training.training_data import DataOptions

    pick_device(device)
    if (test is None) == (split is None):
        raise ConfigError("give either --test DATA, recordings to test on, or --split easy or hard for KITTI odometry")
    chosen = _choose_rows(table, None if rows is None else common.split_names(rows), split)
    folder = out or Path("ablation") / f"table-{table}"
    shards = cache or folder.parent / "shards"
    check_output(shards)
    recipes = {row: _recipes(row, base, seeds, reduced) for row in chosen}
    runs = [folder / recipe.name for row in chosen for recipe in recipes[row]]
    for run in runs:
        TRAINING.check(run)
    options = DataOptions(shards, None, None, reader, raw_root, topics)
    with claimed(folder, table_files(table)) if is_first_process() else nullcontext():
        if is_first_process():
            for run in runs:
                TRAINING.remove_leftovers(run)
        lines = _run_rows(table, chosen, _row_runner(data, test, options, folder, steps, recipes, device))
        _finish(folder, table, lines, _budget(steps, seeds, base, reduced))


def _choose_rows(number: int, presets: tuple[str, ...] | None, split: str | None) -> list[TableRow]:
    """Return the rows to train: with a split, all of them; without one, one row per preset, whatever its split."""
    from hybridlio.learned.paper_tables import split as sequences_of
    from hybridlio.learned.paper_tables import table
    from hybridlio.learned.presets import preset

    rows = [row for row in table(number) if presets is None or row.preset in presets]
    if not rows:
        known = ", ".join(dict.fromkeys(row.preset for row in table(number)))
        raise ConfigError(f"--rows: table {number} has none of these presets; choose from {known}")
    if split is not None:
        sequences_of(split, preset(rows[0].preset).network)
        return [row if row.split else replace(row, split=split) for row in rows]
    return [replace(row, split=None) for k, row in enumerate(rows) if row.preset not in {r.preset for r in rows[:k]}]


def _recipes(row: TableRow, base: str, seeds: int, small: bool) -> list[Recipe]:
    """Return the recipe of a row for each seed, named as its folder."""
    from hybridlio.learned.presets import row_of
    from hybridlio.learned.training.ablation import reduced

    recipe = row_of(base, row.preset)
    recipe = reduced(recipe) if small else recipe
    names = [row.name] if seeds == 1 else [f"{row.name}-seed-{seed}" for seed in range(seeds)]
    seeded = [replace(recipe.optimiser, seed=seed) for seed in range(seeds)]
    return [replace(recipe, name=name, optimiser=optimiser) for name, optimiser in zip(names, seeded, strict=True)]


def _budget(steps: int, seeds: int, base: str, reduced: bool) -> str:
    of_seeds = f", {seeds} seeds" if seeds > 1 else ""
    of_base = f", variants of {base}" if base != "paper" else ""
    return f"{steps} steps per row{of_seeds}{of_base}{', reduced size' if reduced else ''}"


def _row_runner(
    data: list[Path],
    test: list[Path] | None,
    options: DataOptions,
    folder: Path,
    steps: int,
    recipes: Mapping[TableRow, list[Recipe]],
    device: str,
) -> RunRow:
    """Return a function that trains and evaluates a row with each of its recipes."""
    from hybridlio.learned.training.ablation import RowData, run_rows
    from hybridlio.learned.training.run_options import RunOptions
    from hybridlio.runs.training.training_data import prepare_shards, split_options

    run_options = RunOptions(device=None if device == "auto" else device)

    def prepared(recipe: Recipe, split: str | None) -> RowData:
        train, tests = split_options(options, split, recipe)
        with first_process_progress("preparing", "scans") as report:
            parts = [
                prepare_shards(paths, recipe, part, report) for paths, part in ((data, train), (test or data, tests))
            ]
        return RowData(*parts)

    def run(row: TableRow) -> tuple[RowResult, ...]:
        with first_process_progress(row.name, "steps") as report:
            results = run_rows(
                recipes[row],
                lambda recipe: prepared(recipe, row.split),
                folder,
                steps,
                run_options,
                lambda recipe, p: report(
                    f"{recipe.name}: loss {p.loss:.4g}, {p.pairs_per_s:.1f} pairs/s", p.step, steps
                ),
            )
        return tuple(results)

    return run


def _run_rows(number: int, chosen: list[TableRow], run: RunRow) -> list[Line]:
    """Return all lines of the table; those of chosen rows with their results."""
    from hybridlio.learned.training.comparison import Line
    from hybridlio.learned.training.published import published

    wanted, lines = {row.published: row for row in chosen}, []
    for figures in published(number):
        row = wanted.get(figures.method)
        if row is None:
            lines.append(Line(figures.method, None, (), figures))
            continue
        try:
            lines.append(Line(figures.method, row.preset, run(row), figures))
        except KeyboardInterrupt:
            print_message("interrupted; the same command resumes")
            raise typer.Exit(INTERRUPTED) from None
        except HybridLioError as error:
            print_message(f"error: {row.name}: {error}")
            lines.append(Line(figures.method, row.preset, (), figures, str(error)))
    return lines


def _finish(folder: Path, number: int, lines: list[Line], budget: str) -> None:
    from hybridlio.core.files import write_atomically
    from hybridlio.learned.training.comparison import LEGEND, tables, to_json_dict, to_markdown

    if not is_first_process():
        return
    text = json.dumps(to_json_dict(number, lines, budget), indent=2, ensure_ascii=False)
    write_atomically(folder / f"table-{number}.json", text + "\n")
    write_atomically(folder / f"table-{number}.md", to_markdown(number, lines, budget))
    for title, rows in tables(lines).items():
        print_table(_table(f"table {number}, {title}: {budget}", rows, LEGEND))
    print_result(f"wrote {folder / f'table-{number}.md'} and {folder / f'table-{number}.json'}")
    if any(line.error for line in lines):
        raise typer.Exit(common.FAILED)


def _table(title: str, rows: list[dict[str, str]], legend: str) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    out = Table(title=Text(title), caption=Text(legend), box=box.SIMPLE_HEAD, padding=0)
    for name in rows[0]:
        out.add_column(Text(name), justify="left" if name in ("method", "figures") else "right")
    for row in rows:
        out.add_row(*map(Text, row.values()))
    return out
