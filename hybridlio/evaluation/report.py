"""Write a run's report: one HTML file that contains its plots and loads nothing from elsewhere."""

from __future__ import annotations

import base64
import os
import platform
from collections.abc import Mapping
from importlib import metadata, resources
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlio.core.files import write_atomically
from hybridlio.core.version import __version__
from hybridlio.evaluation.consistency import Anees
from hybridlio.evaluation.drift import Drift
from hybridlio.evaluation.evaluate import Evaluation
from hybridlio.evaluation.metrics_table import format_metrics, metric_rows
from hybridlio.evaluation.report_data import DrawnPath, Findings, ReportData, analyse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Findings", "ReportData", "analyse", "draw", "figures", "write_report"]

_PACKAGES = ("numpy", "scipy", "gtsam", "small_gicp", "open3d", "torch", "filterpy")
_MAX_RANGES_LISTED = 200  # about a page


def write_report(
    path: str | os.PathLike[str],
    data: ReportData,
    findings: Findings | None = None,
    drawn: Mapping[str, bytes] | None = None,
) -> None:
    """Write the report, completely or not at all.

    Args:
        path: the HTML file.
        data: the run.
        findings: the result of :func:`analyse` on ``data``, if it exists already.
        drawn: the result of :func:`draw`, if it exists already.

    Raises:
        DataError: the file cannot be written.
    """
    import jinja2

    findings = analyse(data) if findings is None else findings
    drawn = draw(data, findings) if drawn is None else drawn
    text = resources.files("hybridlio.evaluation").joinpath("report.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    write_atomically(path, environment.from_string(text).render(_page(data, findings, drawn)))


def draw(data: ReportData, findings: Findings) -> dict[str, bytes]:
    """Return the :func:`figures` as PNG files, by name."""
    from hybridlio.evaluation.plots import to_png

    return {name: to_png(figure) for name, figure in figures(data, findings).items()}


def figures(data: ReportData, findings: Findings) -> dict[str, Figure]:
    """Return the figures that the data allow: trajectory, drift, steps, timing, nees, sigma_steps, sigma_poses."""
    from hybridlio.evaluation import plots

    reference = None if data.reference is None or not findings.evaluations else data.reference.poses[:, :3, 3]
    bridged = None if data.ok is None else _bridged_m(data, findings)
    loops = None if data.loops is None else _loops_m(data.loops, findings.paths[data.estimate_name])
    out = {"trajectory": plots.trajectory_figure(findings.paths, reference, bridged, loops)}
    drifts = {name: _drift(evaluation) for name, evaluation in findings.evaluations.items()}
    drifts = {name: drift for name, drift in drifts.items() if len(drift)}
    if drifts:
        out["drift"] = plots.drift_figure(drifts)
    if findings.step_errors:
        out["steps"] = plots.step_error_figure(findings.step_errors)
    if data.timings_s:
        out["timing"] = plots.timing_figure(data.timings_s, data.period_s)
    if findings.steps is not None:
        out["nees"] = plots.nees_figure(findings.steps.times_s, findings.steps.consistency)
        out["sigma_steps"] = plots.sigma_figure(findings.steps.times_s, findings.steps.consistency)
    if findings.poses is not None:
        out["sigma_poses"] = plots.sigma_figure(findings.poses.times_s, findings.poses.consistency)
    return out


def _page(data: ReportData, findings: Findings, drawn: Mapping[str, bytes]) -> dict[str, Any]:
    inline = {name: base64.b64encode(png).decode() for name, png in drawn.items()}
    second = data.first_scan + 1  # the first step leads to the second scan
    bridged = [] if data.ok is None else _ranges(np.flatnonzero(~np.asarray(data.ok, bool)) + second)
    degenerate = [] if data.degenerate is None else _ranges(np.flatnonzero(data.degenerate) + second)
    return {
        "name": data.name,
        "facts": {**_own_facts(data), **data.facts},
        "tiles": _tiles(data, findings),
        "warnings": [*data.warnings, *findings.notes],
        "names": list(findings.evaluations),
        "metrics": metric_rows(format_metrics(e) for e in findings.evaluations.values()),
        "plots": inline,
        "drift_names": [name for name, e in findings.evaluations.items() if len(_drift(e))],
        "drift": _drift_rows(findings),
        "short": any(e.t_rel_percent is None for e in findings.evaluations.values()),
        "step_errors": _step_rows(findings),
        "timing": _timing_rows(data),
        "consistency": _consistency_rows(findings),
        "bridged": bridged,
        "degenerate": degenerate,
        "flags_known": data.ok is not None or data.degenerate is not None,
        "config": data.config.strip(),
        "versions": _versions(),
    }


def _own_facts(data: ReportData) -> dict[str, str]:
    facts = {"scans": f"{len(data.estimate):,}", "path": f"{data.estimate.length_m:,.1f} m"}
    if len(data.estimate) > 1:
        facts["duration"] = f"{data.estimate.times_s[-1]:,.1f} s"
    return facts


def _tiles(data: ReportData, findings: Findings) -> list[tuple[str, str, str]]:
    """Return the headline metrics: label, value, unit."""
    tiles: list[tuple[str, float | None, str]] = []
    own = findings.evaluations.get(data.estimate_name)
    if own is not None:
        lengths = own.chosen_lengths_m
        over = "" if lengths is None else f" over {lengths[0]:g}–{lengths[-1]:g} m"
        if own.t_rel_percent is not None:
            tiles += [
                ("translation drift", own.t_rel_percent, "%"),
                ("rotation drift", own.r_rel_deg_per_100m, "°/100 m"),
            ]
        else:
            tiles += [
                (f"translation drift{over}", own.chosen_t_rel_percent, "%"),
                (f"rotation drift{over}", own.chosen_r_rel_deg_per_100m, "°/100 m"),
            ]
        tiles += [("ATE", own.ate_m, "m"), ("end error", own.end_error_m, "m")]
    if data.timings_s:
        total = sum(np.sum(t) for t in data.timings_s.values())
        tiles.append(("speed", max(map(len, data.timings_s.values())) / float(total), "scans/s"))
    return [(label, _digits(value), unit) for label, value, unit in tiles if value is not None]


def _drift(evaluation: Evaluation) -> Drift:
    shown = evaluation.drift
    return shown if len(shown) or evaluation.chosen_drift is None else evaluation.chosen_drift


def _drift_rows(findings: Findings) -> list[tuple[str, list[str]]]:
    """Return the length, then the translation and rotation drift of each trajectory that has any."""
    columns = [{a.at: a for a in e.segments} for e in findings.evaluations.values() if e.segments]
    rows = []
    for length in sorted({at for column in columns for at in column}):
        cells: list[str] = []
        for column in columns:
            average = column.get(length)
            cells += (
                ["–", "–"] if average is None else [f"{average.t_rel_percent:.3f}", f"{average.r_rel_deg_per_100m:.3f}"]
            )
        rows.append((f"{length:g}", cells))
    return rows


def _step_rows(findings: Findings) -> list[tuple[str, list[str]]]:
    rows = []
    for name, (_, errors) in findings.step_errors.items():
        metres, degrees = np.linalg.norm(errors[:, 3:], axis=1), np.degrees(np.linalg.norm(errors[:, :3], axis=1))
        cells = [_digits(f(v)) for v in (metres, degrees) for f in (np.median, lambda v: np.quantile(v, 0.95), np.max)]
        rows.append((name, cells))
    return rows


def _timing_rows(data: ReportData) -> list[tuple[str, list[str]]]:
    total = sum(float(np.sum(t)) for t in data.timings_s.values())
    return [
        (
            stage,
            [
                *(f"{1e3 * v:.2f}" for v in (np.median(t), np.mean(t), np.quantile(t, 0.99), np.max(t))),
                f"{np.sum(t) / total:.0%}",
            ],
        )
        for stage, t in data.timings_s.items()
    ]


def _consistency_rows(findings: Findings) -> list[tuple[str, list[str]]]:
    """Return ANEES, its root, bounds and verdict. Absolute poses have no bounds and verdict, see :class:`Anees`."""
    rows = []
    for name, timed in (("steps", findings.steps), ("poses", findings.poses)):
        for part in ("rotation", "position") if timed is not None else ():
            result = getattr(timed.consistency, part)  # type: ignore[union-attr]
            verdict = [f"{result.lower:.3f}–{result.upper:.3f}", _verdict(result)] if name == "steps" else ["–", "–"]
            rows.append((f"{name}, {part}", [_digits(result.value), _digits(np.sqrt(result.value)), *verdict]))
    return rows


def _verdict(result: Anees) -> str:
    if result.consistent:
        return "consistent"
    too_small = result.value > 1
    factor = np.sqrt(result.value if too_small else 1 / max(result.value, 1e-12))
    return f"σ {_digits(factor)} times too {'small' if too_small else 'large'}"


def _bridged_m(data: ReportData, findings: Findings) -> Any:
    path = findings.paths[data.estimate_name]
    return path.positions_m[np.isin(path.rows, np.flatnonzero(~np.asarray(data.ok, bool)) + 1)]


def _loops_m(loops: Any, path: DrawnPath) -> Any:
    """Return ``(L, 2, 3)`` positions of the loops whose two ends are drawn."""
    drawn = loops[np.isin(loops, path.rows).all(axis=1)]
    return path.positions_m[np.searchsorted(path.rows, drawn)]


def _ranges(frames: Any) -> list[str]:
    """Return frame numbers as text, with consecutive ones joined: ``4``, ``7–9`` …, at most a page."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1) if len(frames) else []
    texts = [f"{run[0]}" if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs]
    more = len(texts) - _MAX_RANGES_LISTED
    return texts[:_MAX_RANGES_LISTED] + ([f"and {more} more"] if more > 0 else [])


def _digits(value: float) -> str:
    return f"{value:#.3g}" if abs(value) < 100 else f"{value:,.0f}"


def _versions() -> dict[str, str]:
    out = {"hybridlio": __version__, "Python": platform.python_version()}
    for package in _PACKAGES:
        try:
            out[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return out
