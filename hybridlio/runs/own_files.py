"""The files that each command writes, and how they are told from files of the same names by somebody else."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridlio.core.errors import ConfigError
from hybridlio.core.files import remove_leftovers
from hybridlio.runs.folder import FILES, GRAPH, JOB, LOG, METRICS, RECORD, SMOOTHED, is_own_file
from hybridlio.runs.whole_folder import JOURNAL


@dataclass(frozen=True)
class OwnFiles:
    """The files that a command writes to a folder.

    Attributes:
        names: their names.
        marker: the one among them that identifies all: a JSON object.
        keys: keys that this object always has.
    """

    names: tuple[str, ...]
    marker: str
    keys: frozenset[str]

    def are_in(self, folder: Path) -> bool:
        """Return whether the command wrote its files to the folder before."""
        return self.keys <= _keys(folder / self.marker)

    def remove_leftovers(self, folder: Path) -> None:
        """Remove what killed processes left of the files. The caller holds the folder."""
        for name in self.names:
            remove_leftovers(folder / name)

    def check(self, folder: Path) -> None:
        """Check that writing the files, or removing them, concerns no file of somebody else.

        Raises:
            ConfigError: the folder holds a file of such a name, but not the command's marker.
        """
        present = [name for name in self.names if (folder / name).exists() or (folder / name).is_symlink()]
        if present and not self.are_in(folder):
            raise ConfigError(f"{folder / present[0]} was not written by hybridlio; choose another folder with -o")


def _keys(path: Path) -> set[str]:
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return set()
    return set(content) if isinstance(content, dict) else set()


RUN = OwnFiles((*FILES, SMOOTHED), METRICS, frozenset({"hybridlio", "sequence"}))
BATCH_JOB = OwnFiles((JOB, LOG), JOB, frozenset({"recording", "settings"}))
BATCH = OwnFiles(("batch.json", "batch.md"), "batch.json", frozenset({"summary", "recordings"}))
COMPARISON = OwnFiles(("compare.json", "compare.md"), "compare.json", frozenset({"sequence", "scans", "rows"}))
MERGE = OwnFiles(("merge.json", GRAPH), "merge.json", frozenset({"runs", "pairs", "unjoined"}))
TRAINING = OwnFiles(
    ("recipe.json", "checkpoint.pt", "weights.safetensors", "best.safetensors", "log.jsonl"),
    "recipe.json",
    frozenset({"name", "network", "loss", "optimiser"}),
)


def table_files(number: int) -> OwnFiles:
    """Return the files of the ablation's table ``number``."""
    name = f"table-{number}"
    return OwnFiles((f"{name}.json", f"{name}.md"), f"{name}.json", frozenset({"table", "budget", "lines"}))


def check_free(folder: Path, overwrite: bool) -> None:
    """Check that a run may be written to the folder: it is missing, empty, or holds a run and ``overwrite`` is set.

    A folder with only the log of a run that failed is free, too.

    Raises:
        ConfigError: it may not.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; choose another name")
    is_run = RUN.are_in(folder)
    if is_run and not overwrite:
        more = ", or --resume to go on with it" if (folder / JOURNAL).is_file() else ""
        raise ConfigError(
            f"{folder} already holds a run; choose another folder, or give --overwrite to replace it{more}"
        )
    if not (is_run or BATCH_JOB.are_in(folder) or _is_unused(folder) or (overwrite and _is_half_run(folder))):
        raise ConfigError(f"{folder} holds files but no run of hybridlio, and is left alone; choose another folder")


def _is_unused(folder: Path) -> bool:
    return all(one.name in (".lock", ".partial", ".old", ".complete") for one in folder.iterdir())


def _is_half_run(folder: Path) -> bool:
    """Return whether the folder holds nothing but files of a run that was killed while it wrote in place."""
    return (folder / RECORD).is_file() and all(is_own_file(p.relative_to(folder)) for p in folder.iterdir())
