"""Helpers that several benchmarks share: recordings, evaluation, memory, tables and what times depend on."""

from __future__ import annotations

import argparse
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.errors import HybridLioError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.evaluation.evaluate import Evaluation, evaluate

Figures = dict[str, Any]

MIB = 2**20
_PACKAGES = ("hybridlio", "kiss-icp", "rko_lio", "small_gicp", "open3d", "gtsam", "numpy")


def open_part(data: Path, sequence: str | None, frames: str | None) -> Sequence:
    """Open the frames ``A:B`` of a recording, all of them for None."""
    return part_of(open_sequence(data, sequence=sequence), frames)


def nanoseconds(seconds: Array) -> NDArray[np.int64]:
    """Return times in whole nanoseconds."""
    return np.round(seconds * NS_PER_S).astype(np.int64)


def resident_mib() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def evaluation_of(trajectory: Trajectory, sequence: Sequence) -> Evaluation | None:
    """Evaluate against the recording's reference; None without a reference that moves, or if evaluation fails."""
    if sequence.reference is None or sequence.reference.length_m < 1:
        return None
    try:
        return evaluate(trajectory, sequence.reference)
    except HybridLioError as error:
        print(f"not evaluated: {error}")
        return None


def drift_of(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return t_rel [%] and r_rel [°/100 m] over KITTI's segment lengths, or over lengths that fit a shorter path."""
    if evaluation.t_rel_percent is not None:
        return evaluation.t_rel_percent, evaluation.r_rel_deg_per_100m
    return evaluation.chosen_t_rel_percent, evaluation.chosen_r_rel_deg_per_100m


def forward_error(trajectory: Trajectory, sequence: Sequence) -> tuple[Array, float]:
    """Compare the distance travelled forward with the integrated forward speed of the recording.

    Both are of the navigation unit, as the lidar in front of it travels farther in bends. Errors of opposite sign
    cancel in the total, so look at the errors over single seconds as well.

    Returns:
        the excess of the trajectory's distance over the speed's at each scan, ``(N,)`` m, and the speed's total, m.
    """
    seconds, speed = sequence.stamps_ns / 1e9, sequence.forward_speed_m_s
    assert speed is not None
    driven_m = np.diff(seconds) * (speed[1:] + speed[:-1]) / 2
    poses = trajectory.poses @ se3.inverse(sequence.calibration.T_imu_lidar)
    steps = se3.between(poses[:-1], poses[1:])
    halfway = se3.so3_exp(se3.so3_log(steps[:, :3, :3]) / 2)  # the mean heading of a step
    forward_m = np.einsum("nji,nj->ni", halfway, steps[:, :3, 3])[:, 0]
    return np.concatenate([[0.0], np.cumsum(forward_m - driven_m)]), float(driven_m.sum())


def table_of(systems: dict[str, Figures], text_columns: tuple[str, ...] = ("system",)) -> str:
    """Return a Markdown table with one row for each system; columns of text are aligned left."""
    rows = [{"system": name, **{key: _cell(value) for key, value in row.items()}} for name, row in systems.items()]
    return tables.to_markdown(rows, text_columns)


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else tables.NOTHING if value is None else str(value)


def circumstances(options: argparse.Namespace) -> Figures:
    """Return what times depend on: threads, repeats, the machine and its load, versions of packages."""
    return {
        "threads": options.threads,
        "repeats": options.repeats,
        "cores": os.cpu_count(),
        "load": [round(value, 1) for value in os.getloadavg()],
        "machine": platform.machine(),
        "packages": {
            p.metadata["Name"]: p.version for p in metadata.distributions() if p.metadata["Name"] in _PACKAGES
        },
    }
