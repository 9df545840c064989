"""The log of a training run: JSON lines, and optional TensorBoard event files."""

from __future__ import annotations

import importlib.util
import json
import math
import os
from pathlib import Path
from typing import Any

from hybridlio.core.errors import DataError
from hybridlio.core.files import write_atomically


class TrainingLog:
    """Writer of numbers by step to ``log.jsonl`` and ``tensorboard/``.

    Event files are written only if tensorboardX is installed.

    Args:
        folder: folder of the run.
        step: step of the last checkpoint. Later rows of an interrupted run are deleted.
    """

    def __init__(self, folder: str | os.PathLike[str], step: int) -> None:
        self.path = Path(folder) / "log.jsonl"
        rows = read_log(self.path) if self.path.is_file() else []
        write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in rows if row["step"] <= step))
        self._board = _tensorboard(Path(folder) / "tensorboard", step)

    def write(self, step: int, **values: float | None) -> None:
        """Add a row; unknown and infinite numbers become null."""
        known = {name: v if v is not None and math.isfinite(v) else None for name, v in values.items()}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **known}) + "\n")
        if self._board is not None:
            for name, value in known.items():
                if value is not None:
                    self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Write buffered events."""
        if self._board is not None:
            self._board.close()


def read_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Return the rows of a ``log.jsonl``, without an incomplete last line.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").split("\n")[:-1]
        rows = [json.loads(line) for line in lines]
        if not all(isinstance(row, dict) and isinstance(row["step"], int) for row in rows):
            raise DataError("a row is no object with a step")
    except (OSError, ValueError, KeyError, RecursionError, DataError) as error:
        raise DataError(f"{path}: not the log of a training run ({error}); delete it to go on") from error
    return rows


def _tensorboard(folder: Path, step: int) -> Any:
    if importlib.util.find_spec("tensorboardX") is None:
        return None
    from tensorboardX import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1 if step else None, write_to_disk=True)
