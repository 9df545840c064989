"""What the commands that train share: their device, and the process that prints."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import progress
from hybridlio.core.progress import Progress

Device = Annotated[
    str,
    typer.Option(
        metavar="NAME", autocompletion=completion.device, help="cpu, cuda, …; auto uses a GPU if there is one."
    ),
]


def is_first_process() -> bool:
    """Return whether this is the process that prints, of those that torchrun started."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def first_process_progress(task: str, unit: str) -> Iterator[Progress]:
    """Show progress in the first process, and nothing in the others."""
    if not is_first_process():
        yield lambda _stage, _done, _total: None
        return
    with progress(task, unit) as report:
        yield report
