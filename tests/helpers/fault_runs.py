"""A run of the odometry over a drive with a fault: how far off it is, by its own covariances, and what it says."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from fault_rows import Row

from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import notes

_THREE_SIGMAS = 14.16  # 99.73 % quantile of χ² with three degrees of freedom
GROSS_NEES = 25.0  # 99.998 % quantile


@dataclass(frozen=True)
class Outcome:
    """A run with a fault, and what the run and the log say beside what the drive's own notes say."""

    run: Run
    said: str

    @cached_property
    def errors_m(self) -> Any:
        """Errors of the positions ``(N, 3)``, in the frame of the first scan."""
        reference = self.run.sequence.reference
        assert reference is not None
        done = self.run.done
        assert (reference.stamps_ns[:done] == self.run.trajectory.stamps_ns).all()
        return self.run.trajectory.poses[:, :3, 3] - reference.poses[:done, :3, 3]

    @property
    def largest_m(self) -> float:
        """The largest horizontal error."""
        return float(np.linalg.norm(self.errors_m[:, :2], axis=1).max())

    @cached_property
    def nees(self) -> Any:
        """The normalised squared error of each position after the first."""
        trajectory = self.run.trajectory
        assert trajectory.covariances is not None
        R = trajectory.poses[1:, :3, :3]
        covariances = R @ trajectory.covariances[1:, 3:, 3:] @ R.transpose(0, 2, 1)
        off = self.errors_m[1:]
        return np.einsum("ni,ni->n", off, np.linalg.solve(covariances, off[..., None])[..., 0])

    @property
    def off_share(self) -> float:
        """The share of the positions after the first that are off by more than three standard deviations."""
        return float(np.mean(self.nees > _THREE_SIGMAS))


class _Warnings(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def _logged() -> Iterator[list[str]]:
    handler = _Warnings()
    logging.getLogger().addHandler(handler)
    try:
        yield handler.lines
    finally:
        logging.getLogger().removeHandler(handler)


def run_row(row: Row, whole: Sequence) -> Outcome:
    """Run the odometry with its defaults over a drive with a row's fault, to its end."""
    with _logged() as lines:
        run = run_odometry(row.inject(whole), Odometry())
        added = [line for line in notes(run)[len(whole.notes) :] if "injected fault" not in line]
    assert run.stopped is None
    assert run.done == row.scans
    return Outcome(run, "; ".join([*added, *lines]))
