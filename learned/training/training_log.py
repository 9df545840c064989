"""The log of a training run: one JSON object a line, and the same as event files, which TensorBoard reads."""

from __future__ import annotations

import importlib.util
import json
import math
import os
from pathlib import Path
from typing import Any

from hybridlio.core.files import write_atomically


class TrainingLog:
    """Rows of numbers by step, in ``log.jsonl`` and in ``tensorboard/``.

    Event files are written by tensorboardX, which needs no TensorBoard; a bare training machine may do without either.

    Args:
        folder: of the run.
        step: rows of later steps, which an interrupted run left behind its last checkpoint, are dropped.
    """

    def __init__(self, folder: str | os.PathLike[str], step: int) -> None:
        self.path = Path(folder) / "log.jsonl"
        rows = read_log(self.path) if self.path.is_file() else []
        write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in rows if row["step"] <= step))
        self._board = _tensorboard(Path(folder) / "tensorboard", step)

    def write(self, step: int, **values: float | None) -> None:
        """Add a row; numbers that are not known or not finite are written as null."""
        known = {name: v if v is not None and math.isfinite(v) else None for name, v in values.items()}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **known}) + "\n")
        if self._board is not None:
            for name, value in known.items():
                if value is not None:
                    self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Write out what TensorBoard has not yet."""
        if self._board is not None:
            self._board.close()


def read_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The rows of a ``log.jsonl``; a last line that was cut off is left out."""
    lines = Path(path).read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def _tensorboard(folder: Path, step: int) -> Any:
    if importlib.util.find_spec("tensorboardX") is None:
        return None
    from tensorboardX import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1 if step else None, write_to_disk=True)
