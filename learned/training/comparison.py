"""A comparison in the form of the paper's tables: drift by recording, means over training and test recordings.

Measured and published figures are listed together; published ones are marked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hybridlio.learned.training.ablation_results import Drift, RowResult
from hybridlio.learned.training.published import TEST, TRAIN, PublishedRow

KITTI = tuple(f"{n:02}" for n in range(11))
LEGEND = (
    "t_rel [%] / r_rel [°/100 m], of several seeds their mean ± half of their range; published: as printed in "
    "UnDeepLIO's tables, trained and tested on KITTI odometry"
)
_NOTHING = "–"


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        method: name in the paper.
        preset: name of the trained preset; None for a method with published figures only.
        results: measured figures of each seed; empty where there are none or training failed.
        published: the paper's figures.
        error: why training failed, if it did.
    """

    method: str
    preset: str | None
    results: tuple[RowResult, ...]
    published: PublishedRow
    error: str | None = None


def tables(lines: Sequence[Line]) -> dict[str, list[dict[str, str]]]:
    """Return tables by title, each a list of rows with the same columns.

    For KITTI's sequences there is one table. For other recordings there are two: the measured figures beside the
    published means, and the published figures by sequence.
    """
    recordings = _recordings(lines)
    if set(recordings) <= set(KITTI):
        rows = [row for line in lines for row in (_measured(line, KITTI), _published(line)) if row is not None]
        return {"KITTI odometry": rows}
    measured = [row for line in lines if (row := _measured(line, recordings)) is not None]
    averages = {line.method: _averages(line.published) for line in lines}
    beside = [{**row, **averages[row["method"]]} for row in measured]
    return {"measured": beside, "published, KITTI odometry": [_published(line) for line in lines]}


def to_markdown(number: int, lines: Sequence[Line], budget: str) -> str:
    """Return the comparison as Markdown."""
    parts = [f"# Table {number}\n\n{budget}\n\n{LEGEND}"]
    for title, rows in tables(lines).items():
        cells = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
        parts.append(f"## {title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in cells))
    failed = [f"* {line.method}: {line.error}" for line in lines if line.error]
    return "\n\n".join(parts + (["## Failed\n\n" + "\n".join(failed)] if failed else [])) + "\n"


def to_json_dict(number: int, lines: Sequence[Line], budget: str) -> dict[str, Any]:
    """Return the comparison as plain values."""
    return {"table": number, "budget": budget, "lines": [asdict(line) for line in lines]}


def _recordings(lines: Sequence[Line]) -> tuple[str, ...]:
    results = [result for line in lines for result in line.results]
    return tuple(dict.fromkeys(name for result in results for name in (*result.train, *result.test)))


def _measured(line: Line, recordings: Sequence[str]) -> dict[str, str] | None:
    if line.preset is None:
        return None
    row = {"method": line.method, "figures": f"measured ({line.preset})"}
    drifts = [{**result.train, **result.test} for result in line.results]
    row |= {name: _cell([drift.get(name) for drift in drifts]) for name in recordings}
    averages = {
        "train avg": _cell([result.train_average for result in line.results]),
        "test avg": _cell([result.test_average for result in line.results]),
    }
    return row | averages


def _published(line: Line) -> dict[str, str]:
    figures = {name: _both(line.published, name) for name in KITTI}
    row = {"method": line.method, "figures": "published"}
    return row | figures | {f"{part} avg": _both(line.published, part) for part in (TRAIN, TEST)}


def _averages(row: PublishedRow) -> dict[str, str]:
    return {f"published {part} avg": _both(row, part) for part in (TRAIN, TEST)}


def _both(row: PublishedRow, name: str) -> str:
    t, r = row.t_rel_percent.get(name), row.r_rel_deg_per_100m.get(name)
    return _NOTHING if t is None or r is None else _cell([(t, r)])


def _cell(seeds: Sequence[Drift | None]) -> str:
    """Return the drift of several seeds as text; nothing if one of them has none."""
    known = [drift for drift in seeds if drift is not None]
    if not known or len(known) < len(seeds):
        return _NOTHING
    return " / ".join(_mean_and_spread(values) for values in zip(*known, strict=True))


def _mean_and_spread(values: Sequence[float]) -> str:
    mean = f"{sum(values) / len(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ± {(max(values) - min(values)) / 2:.2f}"
