"""An evaluation in words and columns, for the terminal and for reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from hybridlio.evaluation.evaluate import Evaluation


def evaluation_table(evaluations: Mapping[str, Evaluation], title: str | None = None) -> Table:
    """A table for the terminal: a row for each figure, a column for each evaluation."""
    from rich.table import Table
    from rich.text import Text  # plain text: in markup "[m]" would be a style

    columns = {name: figures(evaluation) for name, evaluation in evaluations.items()}
    table = Table("figure", title=None if title is None else Text(title))
    for name in columns:
        table.add_column(Text(name), justify="right")
    for heading in dict.fromkeys(heading for column in columns.values() for heading in column):
        table.add_row(Text(heading), *(column.get(heading, "–") for column in columns.values()))
    return table


def figures(evaluation: Evaluation) -> dict[str, str]:
    """The figures worth a line, under headings that carry their units; what could not be computed is left out."""
    e = evaluation
    lengths = "" if e.chosen_lengths_m is None else f"over {e.chosen_lengths_m[0]:g}–{e.chosen_lengths_m[-1]:g} m"
    values: dict[str, float | None] = {
        "t_rel [%]": e.t_rel_percent,
        "r_rel [°/100 m]": e.r_rel_deg_per_100m,
        f"drift {lengths} [%]": e.chosen_t_rel_percent,
        f"turn {lengths} [°/100 m]": e.chosen_r_rel_deg_per_100m,
        "ATE [m]": e.ate_m,
        "ATE [°]": e.ate_deg,
        "RPE a frame [m]": e.rpe_m,
        "RPE a frame [°]": e.rpe_deg,
        "end error [m]": e.end_error_m,
        "ANEES rotation": e.anees_rotation,
        "ANEES position": e.anees_position,
        "ANEES steps, rotation": e.step_anees_rotation,
        "ANEES steps, position": e.step_anees_position,
    }
    lengths_text = {"length [m]": f"{e.length_m:.1f}", "estimated [m]": f"{e.estimate_length_m:.1f}"}
    return lengths_text | {heading: f"{value:.3f}" for heading, value in values.items() if value is not None}
