"""Write a run's report: one HTML file that contains its charts and loads nothing from elsewhere."""

from __future__ import annotations

import json
import os
import platform
from importlib import metadata, resources
from typing import Any

import numpy as np

from hybridlio.core.files import write_atomically
from hybridlio.core.trajectory import travelled_m
from hybridlio.core.version import __version__
from hybridlio.evaluation.charts.consistency_charts import drift_figure, nees_figure, sigma_figure
from hybridlio.evaluation.charts.path_charts import map_figure, space_figure
from hybridlio.evaluation.charts.plotly import Figure, packed_library
from hybridlio.evaluation.charts.sensor_charts import bias_figure, fix_figure
from hybridlio.evaluation.charts.time_charts import step_figure, timeline_figure, timing_figure
from hybridlio.evaluation.consistency import Anees
from hybridlio.evaluation.drift import Drift
from hybridlio.evaluation.evaluate import Evaluation
from hybridlio.evaluation.metrics_table import format_metrics, metric_rows
from hybridlio.evaluation.report_data import DOUBTFUL, DrawnPath, Findings, ReportData, analyse, stretches
from hybridlio.evaluation.trust import headline, statements

__all__ = ["Findings", "ReportData", "analyse", "charts", "picture", "write_report"]

_PACKAGES = ("numpy", "scipy", "numba", "gtsam", "small_gicp", "open3d", "torch", "filterpy")
_SPEED = "speed"
_MAX_STRETCHES = 200  # about a page


def write_report(path: str | os.PathLike[str], data: ReportData, findings: Findings | None = None) -> None:
    """Write the report, completely or not at all.

    Args:
        path: the HTML file.
        data: the run.
        findings: the result of :func:`analyse` on ``data``, if it exists already.

    Raises:
        DataError: the file cannot be written.
    """
    import jinja2

    findings = analyse(data) if findings is None else findings
    text = resources.files("hybridlio.evaluation").joinpath("report.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    write_atomically(path, environment.from_string(text).render(_page(data, findings)))


def picture(data: ReportData, findings: Findings) -> bytes:
    """Return the paths from above, with height and error, as a PNG file."""
    from hybridlio.evaluation.plots import to_png, trajectory_figure

    reference = None if data.reference is None or not findings.evaluations else data.reference.poses[:, :3, 3]
    bridged = None if data.ok is None else _bridged_m(data, findings)
    loops = None if data.loops is None else _loops_m(data.loops, findings.paths[data.estimate_name])
    return to_png(trajectory_figure(findings.paths, reference, bridged, loops))


def charts(data: ReportData, findings: Findings) -> dict[str, Figure]:
    """Return the charts that the data allow, by name."""
    out = {
        "map": map_figure(data, findings),
        "space": space_figure(data, findings),
        "timeline": timeline_figure(data, findings),
    }
    drifts = {name: _drift(evaluation) for name, evaluation in findings.evaluations.items()}
    drifts = {name: drift for name, drift in drifts.items() if len(drift)}
    if drifts:
        out["drift"] = drift_figure(drifts)
    if findings.step_errors:
        out["steps"] = step_figure(findings)
    if data.biases is not None and np.isfinite(data.biases).any():
        out["biases"] = bias_figure(data)
    if data.fix_residuals_m is not None and len(data.fix_residuals_m):
        out["fixes"] = fix_figure(data)
    if data.timings_s:
        out["timing"] = timing_figure(data)
    if findings.steps is not None:
        out["nees"] = nees_figure(findings.steps)
        out["sigma_steps"] = sigma_figure(findings.steps)
    if findings.poses is not None:
        out["sigma_poses"] = sigma_figure(findings.poses)
    return out


def _page(data: ReportData, findings: Findings) -> dict[str, Any]:
    found = statements(data, findings)
    level, summary = headline(found, data.estimate_name if data.others else "")
    figures = charts(data, findings)
    return {
        "name": data.name,
        "facts": {**_own_facts(data), **data.facts},
        "tiles": _tiles(data, findings),
        "level": level,
        "summary": summary,
        "statements": found,
        "doubtful": bool(data.reference_doubts),
        "warnings": [*(text for text in data.warnings if not text.startswith(DOUBTFUL)), *findings.notes],
        "stretches": _stretch_rows(data),
        "names": list(findings.evaluations),
        "metrics": metric_rows(format_metrics(e) for e in findings.evaluations.values()),
        "charts": {name: figure["layout"]["height"] for name, figure in figures.items()},
        "figures": _script_safe(figures),
        "library": packed_library(),
        "drift_names": [name for name, e in findings.evaluations.items() if len(_drift(e))],
        "drift": _drift_rows(findings),
        "short": any(e.t_rel_percent is None for e in findings.evaluations.values()),
        "step_errors": _step_rows(findings),
        "timing": _timing_rows(data),
        "consistency": _consistency_rows(findings),
        "config": data.config.strip(),
        "versions": _versions(),
    }


def _script_safe(value: Any) -> str:
    """Return JSON that cannot end the script element it stands in, nor be read as markup by Plotly."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _stretch_rows(data: ReportData) -> list[tuple[str, str, str, str]]:
    """Return what is wrong, with scans, times and distances of each stretch, in the order of the run."""
    distance, times = travelled_m(data.estimate.poses[:, :3, 3]), data.estimate.times_s
    rows = [(first, last, name) for name, flagged in data.flagged.items() for first, last in stretches(flagged)]
    texts = [
        (
            name,
            _span(first + data.first_scan, last + data.first_scan),
            f"{times[first]:.1f}" if first == last else f"{times[first]:.1f}–{times[last]:.1f}",
            f"{distance[first]:.0f}" if first == last else f"{distance[first]:.0f}–{distance[last]:.0f}",
        )
        for first, last, name in sorted(rows)
    ]
    more = len(texts) - _MAX_STRETCHES
    return texts[:_MAX_STRETCHES] + ([("", f"and {more} more", "", "")] if more > 0 else [])


def _span(first: int, last: int) -> str:
    return f"{first}" if first == last else f"{first}–{last}"


def _own_facts(data: ReportData) -> dict[str, str]:
    facts = {"scans": f"{len(data.estimate):,}", "path": f"{data.estimate.length_m:,.1f} m"}
    if len(data.estimate) > 1:
        facts["duration"] = f"{data.estimate.times_s[-1]:,.1f} s"
    return facts


def _tiles(data: ReportData, findings: Findings) -> list[tuple[str, str, str, bool]]:
    """Return the headline metrics: label, value, unit, and whether it compares with the reference."""
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
        tiles.append((_SPEED, max(map(len, data.timings_s.values())) / float(total), "scans/s"))
    return [(label, _digits(value), unit, label != _SPEED) for label, value, unit in tiles if value is not None]


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
