"""A comparison in the form of the paper's tables: drift by recording, means over training and test recordings.

Measured and published figures are listed together; published ones are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hybridlio.learned.training.ablation_results import Drift, RowResult
from hybridlio.learned.training.published import TEST, TRAIN, PublishedRow

KITTI = tuple(f"{n:02}" for n in range(11))
LEGEND = (
    "t_rel [%] / r_rel [°/100 m]; published: as printed in UnDeepLIO's tables, trained and tested on KITTI odometry"
)
_NOTHING = "–"


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        method: name in the paper.
        preset: name of the trained preset; None for a method with published figures only.
        result: measured figures; None where there are none or training failed.
        published: the paper's figures.
        error: why training failed, if it did.
    """

    method: str
    preset: str | None
    result: RowResult | None
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
    results = [line.result for line in lines if line.result is not None]
    return tuple(dict.fromkeys(name for result in results for name in (*result.train, *result.test)))


def _measured(line: Line, recordings: Sequence[str]) -> dict[str, str] | None:
    if line.preset is None:
        return None
    row = {"method": line.method, "figures": f"measured ({line.preset})"}
    result = line.result
    drifts: Mapping[str, Drift | None] = {} if result is None else {**result.train, **result.test}
    row |= {name: _cell(drifts.get(name)) for name in recordings}
    averages = (None, None) if result is None else (result.train_average, result.test_average)
    return row | {"train avg": _cell(averages[0]), "test avg": _cell(averages[1])}


def _published(line: Line) -> dict[str, str]:
    figures = {name: _both(line.published, name) for name in KITTI}
    row = {"method": line.method, "figures": "published"}
    return row | figures | {f"{part} avg": _both(line.published, part) for part in (TRAIN, TEST)}


def _averages(row: PublishedRow) -> dict[str, str]:
    return {f"published {part} avg": _both(row, part) for part in (TRAIN, TEST)}


def _both(row: PublishedRow, name: str) -> str:
    t, r = row.t_rel_percent.get(name), row.r_rel_deg_per_100m.get(name)
    return _NOTHING if t is None or r is None else _cell((t, r))


def _cell(drift: Drift | None) -> str:
    return _NOTHING if drift is None else f"{drift[0]:.2f} / {drift[1]:.2f}"
