"""The result of a batch: one row per recording, as a table and as ``batch.json`` and ``batch.md``."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.core import tables
from hybridlio.core.files import write_atomically
from hybridlio.runs.recordings import Recording

if TYPE_CHECKING:
    from rich.table import Table

DONE, DONE_BEFORE, FAILED, NOT_RUN = "done", "done before", "failed", "not run"
_TEXT_COLUMNS = ("recording", "status", "reason")
_METRICS = (
    "frames", "frames_done", "skipped", "bridged", "degenerate", "path_length_m", "length_m", "seconds",
    "t_rel_percent", "r_rel_deg_per_100m", "chosen_lengths_m", "chosen_t_rel_percent", "chosen_r_rel_deg_per_100m",
    "ate_m", "ate_deg", "end_error_m", "anees_rotation", "anees_position",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class BatchRow:
    """The result of one recording.

    Attributes:
        recording: the recording.
        folder: its run folder.
        status: ``done``, ``done before``, ``failed`` or ``not run``.
        reason: why it failed, or None.
        metrics: those of :func:`summary_metrics` that the run has; of a run that failed, up to where it stopped.
    """

    recording: Recording
    folder: Path
    status: str
    reason: str | None = None
    metrics: dict[str, Any] = field(default_factory=dict)

    def to_json_dict(self) -> dict[str, Any]:
        """Return all attributes as plain values."""
        recording = {"name": self.recording.name, **self.recording.to_json_dict(), "folder": self.folder.name}
        return recording | {"status": self.status, "reason": self.reason, **self.metrics}


@dataclass(frozen=True, eq=False)
class Batch:
    """The result of many recordings.

    Attributes:
        out: the folder of the run folders.
        rows: one per recording, in the order given.
        stopped: the interrupt that ended the batch early, or None.
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
        """The number of recordings of each status, in one line."""
        count = Counter(row.status for row in self.rows)
        parts = [f"{count[status]} {status}" for status in (DONE, DONE_BEFORE, FAILED, NOT_RUN) if count[status]]
        return f"{tables.counted(len(self.rows), 'recording')}: {', '.join(parts)}"


def summary_metrics(metrics: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a run's ``metrics.json`` that a summary needs; lists of scans are replaced by their length."""
    out = {name: metrics[name] for name in _METRICS if name in metrics}
    counts = {name: len(out[name]) for name in ("bridged", "degenerate") if name in out}
    return out | counts | {"ms_per_scan": metrics.get("ms_per_scan", {}).get("total")}


def _cells(row: BatchRow) -> dict[str, str]:
    """Return a row's cells by heading. The column ``over`` has the segment lengths of the drift."""
    m, number = row.metrics, tables.number
    lengths, is_kitti = m.get("chosen_lengths_m"), m.get("t_rel_percent") is not None
    prefix = "" if is_kitti else "chosen_"
    over = "100–800 m" if is_kitti else tables.NOTHING if not lengths else f"{lengths[0]:g}–{lengths[-1]:g} m"
    return {
        "recording": row.recording.name,
        "status": row.status,
        "scans": str(m.get("frames_done", tables.NOTHING)),
        "path [m]": number(m.get("path_length_m"), 1),
        "t_rel [%]": number(m.get(f"{prefix}t_rel_percent"), 3),
        "r_rel [°/100m]": number(m.get(f"{prefix}r_rel_deg_per_100m"), 3),
        "over": over,
        "ATE [m]": number(m.get("ate_m"), 3),
        "bridged": str(m.get("bridged", tables.NOTHING)),
        "ms per scan": number(m.get("ms_per_scan"), 0),
        "reason": row.reason or tables.NOTHING,
    }


def table(batch: Batch) -> Table:
    """Return the batch as a table for the terminal."""
    return tables.for_terminal([_cells(row) for row in batch.rows], _TEXT_COLUMNS, batch.summary)


def write_batch(batch: Batch) -> None:
    """Write ``batch.json`` and ``batch.md``.

    Raises:
        DataError: they cannot be written.
    """
    values = {"summary": batch.summary, "recordings": [row.to_json_dict() for row in batch.rows]}
    write_atomically(batch.out / "batch.json", json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    body = tables.to_markdown([_cells(row) for row in batch.rows], _TEXT_COLUMNS)
    write_atomically(batch.out / "batch.md", f"{batch.summary}\n\n{body}\n")
