"""Run the odometry on the same frames with several combinations of sources, and tabulate the results."""

from __future__ import annotations

import json
from collections.abc import Iterable
from collections.abc import Sequence as Items
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlio.core import tables
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.files import write_atomically
from hybridlio.core.progress import Progress
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.ate_rpe import associate
from hybridlio.evaluation.evaluate import Evaluation, associated_step_errors, evaluate
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import forward_speed_length_m

if TYPE_CHECKING:
    from rich.table import Table

_NAMES = ("initial pose", "residual", "backend")
_LEGEND = (
    "initial, final: median error of a step before and after the residual; time, p90: median and 90th percentile per "
    "scan, without reading"
)


@dataclass(frozen=True, eq=False)
class StepErrors:
    """Errors of relative poses against the reference: median and root mean square, in metres and degrees."""

    median_m: float
    median_deg: float
    rms_m: float
    rms_deg: float


@dataclass(frozen=True, eq=False)
class ComparisonRow:
    """The run of one combination.

    Attributes:
        initial_pose, residual, backend: the combination.
        scans: number of scans estimated.
        bridged: number of these at which the residual source failed, so that the initial pose was used.
        path_length_m: of the estimate.
        ms_median, ms_p90: milliseconds per scan, without reading it; None for fewer than two scans.
        initial, final: errors of the steps before and after the residual; None without a reference.
        evaluation: None without a reference.
        error: why the run ended early, or None.
    """

    initial_pose: str
    residual: str
    backend: str
    scans: int
    bridged: int
    path_length_m: float
    ms_median: float | None
    ms_p90: float | None
    initial: StepErrors | None
    final: StepErrors | None
    evaluation: Evaluation | None
    error: str | None

    def to_json_dict(self) -> dict[str, Any]:
        """Return all attributes as plain values."""
        out: dict[str, Any] = dict(vars(self))
        for name in ("initial", "final"):
            out[name] = None if out[name] is None else vars(out[name])
        return out | {"evaluation": self.evaluation.to_json_dict() if self.evaluation else None}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several runs over the same frames.

    Attributes:
        sequence: the recording's name.
        scans: number of frames given to each run.
        reference_length_m: path length of the reference, or None.
        forward_speed_length_m: path length by the vehicle's own forward speed, or None.
        rows: one per run.
        stopped: the interrupt that ended the comparison early, or None.
    """

    sequence: str
    scans: int
    reference_length_m: float | None
    forward_speed_length_m: float | None
    rows: tuple[ComparisonRow, ...]
    stopped: BaseException | None = None


def combinations(
    initial_poses: Items[str], residuals: Items[str], backends: Items[str], config: Config
) -> list[Config]:
    """Return the configuration with every combination of the names."""
    names = ("initial_pose", "residual", "backend")
    combined = product(initial_poses, residuals, backends)
    return [config.model_copy(update=dict(zip(names, c, strict=True))) for c in combined]


def compare_configs(sequence: Sequence, configs: Iterable[Config], progress: Progress | None = None) -> Comparison:
    """Run every configuration over the whole sequence, one after the other.

    A run that fails has a row with what it estimated by then. An interrupt ends the comparison and is returned in
    :attr:`Comparison.stopped`, with the rows so far.

    Args:
        sequence: the recording.
        configs: from :func:`combinations`.
        progress: called after each scan with the combination, scans done and scans in all, summed over all runs.

    Raises:
        ConfigError: a source is unknown.
    """
    odometries = [(config, Odometry(config=config)) for config in configs]  # unknown names fail before the first run
    runs: list[tuple[Config, Run]] = []
    for config, odometry in odometries:
        report = None if progress is None else _summed(progress, config, len(runs), len(odometries))
        run = run_odometry(sequence, odometry, report)
        runs.append((config, run))
        if isinstance(run.stopped, KeyboardInterrupt):
            break
    lengths = [length for _, run in runs if (length := forward_speed_length_m(run)) is not None]
    return Comparison(
        sequence=sequence.name,
        scans=len(sequence),
        reference_length_m=None if sequence.reference is None else sequence.reference.length_m,
        forward_speed_length_m=max(lengths, default=None),
        rows=tuple(_row(config, run) for config, run in runs),
        stopped=next((run.stopped for _, run in runs if isinstance(run.stopped, KeyboardInterrupt)), None),
    )


def _summed(progress: Progress, config: Config, run: int, runs: int) -> Progress:
    """Return the callback of one run, which reports progress over all runs."""
    name = f"{config.initial_pose} + {config.residual}"
    return lambda _stage, done, total: progress(name, run * total + done, runs * total)


def _row(config: Config, run: Run) -> ComparisonRow:
    spent_ms = [sum(e.seconds.values()) * 1e3 for e in run.estimates[1:]]
    reference, evaluation, initial, final = run.sequence.reference, None, None, None
    if reference is not None and len(run.estimates) > 1:
        try:
            evaluation = evaluate(run.trajectory, reference, steps=run.steps)
            initial, final = (_step_errors(run, poses) for poses in (run.initial_poses, run.steps.poses))
        except DataError as error:
            run.stopped = run.stopped or error
    return ComparisonRow(
        initial_pose=config.initial_pose,
        residual=config.residual,
        backend=config.backend,
        scans=len(run.estimates),
        bridged=len(run.bridged),
        path_length_m=run.trajectory.length_m if run.estimates else 0.0,
        ms_median=float(np.median(spent_ms)) if spent_ms else None,
        ms_p90=float(np.percentile(spent_ms, 90)) if spent_ms else None,
        initial=initial,
        final=final,
        evaluation=evaluation,
        error=None if run.stopped is None else str(run.stopped) or "interrupted",
    )


def _step_errors(run: Run, poses: Array) -> StepErrors | None:
    reference = run.sequence.reference
    if reference is None:
        return None
    _, errors = associated_step_errors(associate(run.trajectory, reference), run.trajectory, poses)
    if not len(errors):
        return None
    metres, degrees = np.linalg.norm(errors[:, 3:], axis=1), np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))
    rms_m, rms_deg = (float(np.sqrt(np.mean(values**2))) for values in (metres, degrees))
    return StepErrors(float(np.median(metres)), float(np.median(degrees)), rms_m, rms_deg)


def table(comparison: Comparison) -> Table:
    """Return the comparison as a table for the terminal."""
    return tables.for_terminal(cells(comparison), _NAMES, heading(comparison), _LEGEND)


def heading(comparison: Comparison) -> str:
    """Return one line with the recording and the settings that all rows share."""
    words = [f"{comparison.sequence}: {comparison.scans} scans"]
    if comparison.reference_length_m is not None:
        words.append(f"reference {comparison.reference_length_m:.1f} m")
    if comparison.forward_speed_length_m is not None:
        words.append(f"forward speed {comparison.forward_speed_length_m:.1f} m")
    evaluations = [row.evaluation for row in comparison.rows if row.evaluation is not None]
    short = [e.chosen_lengths_m for e in evaluations if e.t_rel_percent is None and e.chosen_lengths_m is not None]
    words += [f"drift over {short[0][0]:g}–{short[0][-1]:g} m"] if short else []
    used = {name: {getattr(row, name.replace(" ", "_")) for row in comparison.rows} for name in _NAMES}
    words += [f"{name} {values.pop()}" for name, values in used.items() if len(values) == 1]
    return ", ".join(words)


def cells(comparison: Comparison) -> list[dict[str, str]]:
    """Return each row's cells by heading, without columns that are empty or that the title has already."""
    rows = [_cells(row) for row in comparison.rows]
    shared = [name for name in _NAMES[1:] if len({row[name] for row in rows}) == 1]
    shown = [name for name in tables.headings(rows) if name not in shared]
    return [{name: row.get(name, tables.NOTHING) for name in shown} for row in rows]


def _cells(row: ComparisonRow) -> dict[str, str]:
    e = row.evaluation
    out = {"initial pose": row.initial_pose, "residual": row.residual, "backend": row.backend}
    if e is not None:
        is_short = e.t_rel_percent is None
        out["t_rel [%]"] = tables.number(e.chosen_t_rel_percent if is_short else e.t_rel_percent, 3)
        out["r_rel [°/100m]"] = tables.number(e.chosen_r_rel_deg_per_100m if is_short else e.r_rel_deg_per_100m, 3)
        out["ATE [m]"] = tables.number(e.ate_m, 3)
    for name, errors in (("initial", row.initial), ("final", row.final)):
        if errors is not None:
            out[f"{name} [mm]"] = tables.number(1e3 * errors.median_m, 1)
            out[f"{name} [°]"] = tables.number(errors.median_deg, 3)
    out |= {
        "path [m]": tables.number(row.path_length_m, 2),
        "time [ms]": tables.number(row.ms_median, 1),
        "p90 [ms]": tables.number(row.ms_p90, 1),
    }
    out["bridged"] = str(row.bridged)
    end = f"after {tables.counted(row.scans, 'scan')}: {row.error}" if row.error else tables.NOTHING
    return out | {"ended early": end}


def to_markdown(comparison: Comparison) -> str:
    """Return the comparison as a Markdown table."""
    body = tables.to_markdown(cells(comparison), _NAMES)
    return f"{heading(comparison)}\n\n{body}\n\n{_LEGEND}\n"


def write_comparison(folder: Path, comparison: Comparison) -> None:
    """Write ``compare.json`` and ``compare.md``.

    Raises:
        DataError: they cannot be written.
    """
    values = vars(comparison) | {"rows": [row.to_json_dict() for row in comparison.rows]}
    values["stopped"] = comparison.stopped is not None
    write_atomically(folder / "compare.json", json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    write_atomically(folder / "compare.md", to_markdown(comparison))
