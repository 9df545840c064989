"""A batch's outcome: one row a recording, as a table and as ``batch.json`` and ``batch.md``."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.core import tables
from hybridlio.core.files import write_whole
from hybridlio.runs.recordings import Recording

if TYPE_CHECKING:
    from rich.table import Table

DONE, DONE_BEFORE, FAILED, NOT_RUN = "done", "done before", "failed", "not run"
_WORDS = ("recording", "status", "reason")
_FIGURES = (
    "frames", "frames_done", "skipped", "bridged", "degenerate", "path_length_m", "length_m", "seconds",
    "t_rel_percent", "r_rel_deg_per_100m", "chosen_lengths_m", "chosen_t_rel_percent", "chosen_r_rel_deg_per_100m",
    "ate_m", "ate_deg", "end_error_m", "anees_rotation", "anees_position",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class BatchRow:
    """One recording's outcome.

    Attributes:
        recording: what was to be run.
        folder: its run folder.
        status: ``done``, ``done before``, ``failed`` or ``not run``.
        reason: why it failed, or None.
        figures: the figures of ``metrics.json`` that a summary needs, as far as there are any; of a run that failed on
            its way, up to there. Scans that were bridged or left a direction open are counted.
    """

    recording: Recording
    folder: Path
    status: str
    reason: str | None = None
    figures: dict[str, Any] = field(default_factory=dict)

    def to_json_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        said = {"name": self.recording.name, **self.recording.to_json_dict(), "folder": self.folder.name}
        return said | {"status": self.status, "reason": self.reason, **self.figures}


@dataclass(frozen=True, eq=False)
class Batch:
    """Many recordings' outcome.

    Attributes:
        out: the folder of the run folders.
        rows: one a recording, in the order in which they were given.
        stopped: what stopped the batch before its end, such as a KeyboardInterrupt; None for a whole one.
    """

    out: Path
    rows: tuple[BatchRow, ...]
    stopped: BaseException | None = None

    @property
    def failed(self) -> tuple[BatchRow, ...]:
        """The rows of recordings that failed."""
        return tuple(row for row in self.rows if row.status == FAILED)

    @property
    def summary(self) -> str:
        """How many there are of each status."""
        count = Counter(row.status for row in self.rows)
        told = [f"{count[status]} {status}" for status in (DONE, DONE_BEFORE, FAILED, NOT_RUN) if count[status]]
        return f"{tables.counted(len(self.rows), 'recording')}: {', '.join(told)}"


def figures_of(metrics: dict[str, Any]) -> dict[str, Any]:
    """What a summary needs of a run's ``metrics.json``."""
    out = {name: metrics[name] for name in _FIGURES if name in metrics}
    counted = {name: len(out[name]) for name in ("bridged", "degenerate") if name in out}
    return out | counted | {"ms_per_scan": metrics.get("ms_per_scan", {}).get("total")}


def cells(row: BatchRow) -> dict[str, str]:
    """A row in words. Drift is over KITTI's lengths, or over those that fit a shorter path; ``over`` says which."""
    f, number = row.figures, tables.number
    lengths, kitti = f.get("chosen_lengths_m"), f.get("t_rel_percent") is not None
    prefix = "" if kitti else "chosen_"
    over = "100–800 m" if kitti else tables.NOTHING if not lengths else f"{lengths[0]:g}–{lengths[-1]:g} m"
    return {
        "recording": row.recording.name,
        "status": row.status,
        "scans": str(f.get("frames_done", tables.NOTHING)),
        "path [m]": number(f.get("path_length_m"), 1),
        "t_rel [%]": number(f.get(f"{prefix}t_rel_percent"), 3),
        "r_rel [°/100m]": number(f.get(f"{prefix}r_rel_deg_per_100m"), 3),
        "over": over,
        "ATE [m]": number(f.get("ate_m"), 3),
        "bridged": str(f.get("bridged", tables.NOTHING)),
        "ms a scan": number(f.get("ms_per_scan"), 0),
        "reason": row.reason or tables.NOTHING,
    }


def table(batch: Batch) -> Table:
    """The batch for the terminal."""
    return tables.for_terminal([cells(row) for row in batch.rows], _WORDS, batch.summary)


def write_batch(batch: Batch) -> None:
    """Write ``batch.json`` and ``batch.md``.

    Raises:
        DataError: they cannot be written.
    """
    said = {"summary": batch.summary, "recordings": [row.to_json_dict() for row in batch.rows]}
    write_whole(batch.out / "batch.json", json.dumps(said, indent=2, ensure_ascii=False) + "\n")
    body = tables.to_markdown([cells(row) for row in batch.rows], _WORDS)
    write_whole(batch.out / "batch.md", f"{batch.summary}\n\n{body}\n")
