"""A comparison's rows in the paper's form: drift by recording, averages over those trained on and those tested on.

What was measured and what was published stand beside each other, and the latter is marked as such.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hybridlio.learned.training.ablation import Drift, RowResult
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
        method: the name that the paper gives it.
        preset: what was trained for it; None where it has published figures alone.
        result: what was measured; None where nothing was, or it failed.
        published: the paper's figures.
        error: why there is no result, where that is the reason.
    """

    method: str
    preset: str | None
    result: RowResult | None
    published: PublishedRow
    error: str | None = None


def tables(lines: Sequence[Line]) -> dict[str, list[dict[str, str]]]:
    """Tables by title, each a list of rows under the same headings.

    One where the recordings are KITTI's sequences. Else two: what was measured beside the published averages, and the
    published figures by sequence.
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
    """Everything as Markdown."""
    parts = [f"# Table {number}\n\n{budget}\n\n{LEGEND}"]
    for title, rows in tables(lines).items():
        cells = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
        parts.append(f"## {title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in cells))
    failed = [f"* {line.method}: {line.error}" for line in lines if line.error]
    return "\n\n".join(parts + (["## Failed\n\n" + "\n".join(failed)] if failed else [])) + "\n"


def to_json_dict(number: int, lines: Sequence[Line], budget: str) -> dict[str, Any]:
    """Everything as plain values."""
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
