"""Metrics as text with headings and units, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from hybridlio.core.tables import NOTHING

if TYPE_CHECKING:
    from rich.table import Table

    from hybridlio.evaluation.evaluate import Evaluation


def metrics_table(evaluations: Mapping[str, Evaluation], title: str | None = None) -> Table:
    """Return a table for the terminal, with one row per metric and one column per evaluation."""
    from rich.table import Table
    from rich.text import Text  # plain text: in markup "[m]" would be a style

    columns = {name: format_metrics(evaluation) for name, evaluation in evaluations.items()}
    table = Table("metric", title=None if title is None else Text(title))
    for name in columns:
        table.add_column(Text(name), justify="right")
    for heading, cells in metric_rows(columns.values()):
        table.add_row(Text(heading), *cells)
    return table


def metric_rows(columns: Iterable[Mapping[str, str]]) -> list[tuple[str, list[str]]]:
    """Return one row per heading of any column: the heading, then each column's value or a dash."""
    columns = list(columns)
    headings = dict.fromkeys(heading for column in columns for heading in column)
    return [(heading, [column.get(heading, NOTHING) for column in columns]) for heading in headings]


def format_metrics(evaluation: Evaluation) -> dict[str, str]:
    """Return the main metrics by heading with unit; metrics that could not be computed are omitted."""
    e = evaluation
    lengths = "" if e.chosen_lengths_m is None else f"over {e.chosen_lengths_m[0]:g}–{e.chosen_lengths_m[-1]:g} m"
    values: dict[str, float | None] = {
        "t_rel [%]": e.t_rel_percent,
        "r_rel [°/100 m]": e.r_rel_deg_per_100m,
        f"t_rel {lengths} [%]": e.chosen_t_rel_percent,
        f"r_rel {lengths} [°/100 m]": e.chosen_r_rel_deg_per_100m,
        "ATE [m]": e.ate_m,
        "ATE [°]": e.ate_deg,
        "RPE per frame [m]": e.rpe_m,
        "RPE per frame [°]": e.rpe_deg,
        "end error [m]": e.end_error_m,
        "ANEES rotation": e.anees_rotation,
        "ANEES position": e.anees_position,
        "ANEES steps, rotation": e.step_anees_rotation,
        "ANEES steps, position": e.step_anees_position,
    }
    lengths_text = {"reference length [m]": f"{e.length_m:.1f}", "estimate length [m]": f"{e.estimate_length_m:.1f}"}
    return lengths_text | {heading: f"{value:.3f}" for heading, value in values.items() if value is not None}
