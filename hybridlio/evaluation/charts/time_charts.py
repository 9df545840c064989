"""Charts over time: errors, uncertainty, speed and height on one axis, and processing time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.evaluation.charts.path_charts import path_values
from hybridlio.evaluation.charts.plotly import (
    BAD,
    COLOURS,
    DOUBTFUL,
    LEGEND_BELOW,
    REFERENCE,
    Figure,
    Trace,
    axis,
    figure,
    line,
    numbers,
    thinned,
    thinned_peaks,
)
from hybridlio.evaluation.report_data import Findings, ReportData, stretches

_PANEL_PIXELS, _GAP = 150, 0.06  # height of one panel, and the gap between panels as a share of the whole
_MAX_MARKED = 200  # stretches that are marked in the panels
_MAX_BARS = 300  # of the processing time
_PERCENTILE = 0.99


@dataclass(frozen=True, eq=False)
class _Curve:
    """A curve of a panel: ``(N,)`` values at times and at distances travelled."""

    label: str
    values: Array
    times_s: Array
    distance_m: Array
    colour: str
    dash: str = "solid"


def timeline_figure(data: ReportData, findings: Findings) -> Figure:
    """Plot errors, uncertainty, speed and height over time, or over distance, which a button chooses.

    Errors of other trajectories are dashed, in their colours on the map. Bridged and degenerate stretches are marked in
    all panels.
    """
    own = findings.paths[data.estimate_name]
    values = path_values(data, own)
    at = values.times_s, values.distance_m
    sigma = [] if values.sigma_m is None else [_Curve("σ of the position", values.sigma_m, *at, COLOURS[0], "dot")]
    panels: list[tuple[str, list[_Curve]]] = []
    if values.error_m is not None:
        errors = [_Curve("error, aligned at the start", values.error_m, *at, COLOURS[0]), *sigma]
        shape = [_Curve("error, aligned as a whole", own.aligned_error_m, *at, COLOURS[0])]
        for colour, name in zip(COLOURS[1:], data.others, strict=False):
            path = findings.paths[name]
            if len(path.error_m):
                other = (data.times_s(data.others[name])[path.rows], path.travelled_m, colour, "dash")
                errors.append(_Curve(f"{name}, at the start", path.error_m, *other))
                shape.append(_Curve(f"{name}, as a whole", path.aligned_error_m, *other))
        panels += [("error [m]", errors), ("shape error [m]", shape)]
    elif sigma:
        panels.append(("σ [m]", sigma))
    panels.append(("speed [m/s]", [_Curve("speed", values.speed_m_s, *at, COLOURS[4])]))
    panels.append(("height [m]", [_Curve("height", own.positions_m[:, 2], *at, COLOURS[3])]))
    return _panels(panels, _marked(data))


def _panels(panels: list[tuple[str, list[_Curve]]], shapes: list[Any]) -> Figure:
    traces: list[Trace] = []
    over: dict[str, list[Any]] = {"time": [], "distance": []}
    layout: dict[str, Any] = {"shapes": shapes, "hovermode": "x unified", "showlegend": True}
    height = (1 - _GAP * (len(panels) - 1)) / len(panels)
    for k, (title, curves) in enumerate(panels):
        top = 1 - k * (height + _GAP)
        name = "y" if not k else f"y{k + 1}"
        low = {"rangemode": "tozero"} if "height" not in title else {}
        layout[f"yaxis{'' if not k else k + 1}"] = axis(
            title, domain=[max(top - height, 0), top], automargin=True, **low
        )
        for curve in curves:
            kept = thinned_peaks(curve.values)
            times_s, y = curve.times_s[kept], curve.values[kept]
            more = {"line": {"dash": curve.dash}, "yaxis": name, "hovertemplate": "%{y:.3f}"}
            traces.append(line(curve.label, times_s, y, curve.colour, **more))
            over["time"].append(numbers(times_s))
            over["distance"].append(numbers(curve.distance_m[kept]))
    last = "y" if len(panels) == 1 else f"y{len(panels)}"
    layout["xaxis"] = axis("time [s]", anchor=last)
    buttons = [
        {
            "label": f"over {label}",
            "method": "update",
            "args": [{"x": over[label]}, {"xaxis.title.text": unit, "shapes": shapes if label == "time" else []}],
        }
        for label, unit in (("time", "time [s]"), ("distance", "distance travelled [m]"))
    ]
    menu = {"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "xanchor": "left"}
    layout["updatemenus"] = [menu | {"y": 1.02, "yanchor": "bottom", "bgcolor": "#fff", "font": {"color": "#333"}}]
    layout |= {"legend": LEGEND_BELOW, "margin": {"l": 64, "r": 16, "t": 50, "b": 130}}
    return figure(traces, 180 + _PANEL_PIXELS * len(panels), **layout)


def _marked(data: ReportData) -> list[dict[str, Any]]:
    """Return a band over all panels for each stretch of flagged scans."""
    shapes = []
    half_s = (data.period_s or 0.1) / 2
    all_times = data.estimate.times_s
    for name, flagged in data.flagged.items():
        for first, last in stretches(flagged)[:_MAX_MARKED]:
            ends = {"x0": float(all_times[first]) - half_s, "x1": float(all_times[last]) + half_s}
            colour = BAD if name == "bridged" else DOUBTFUL
            shapes.append(
                {"type": "rect", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, **ends, "fillcolor": colour}
                | {"opacity": 0.2, "line": {"width": 0}, "layer": "below"}
            )
    return shapes


def timing_figure(data: ReportData) -> Figure:
    """Plot the processing time: stages stacked over the scans, and the time between scans, the limit of real time."""
    scans = min(map(len, data.timings_s.values()))
    width = -(-scans // _MAX_BARS)
    starts = np.arange(0, scans - width + 1, width)
    traces = []
    for k, (stage, seconds) in enumerate(data.timings_s.items()):
        means = 1e3 * np.add.reduceat(seconds[: starts[-1] + width], starts) / width
        colour = COLOURS[k % len(COLOURS)]
        traces.append(
            line(stage, starts + width / 2 + data.first_scan, means, colour, width=0.5, stackgroup="time")
            | {"hovertemplate": "%{y:.1f} ms"}
        )
    totals = np.sum([seconds[:scans] for seconds in data.timings_s.values()], axis=0)
    if data.period_s is not None and data.period_s < 4 * float(np.quantile(totals, _PERCENTILE)):
        ends = np.array([data.first_scan, data.first_scan + scans], np.float64)
        limit = np.full(2, 1e3 * data.period_s)
        traces.append(line("time between scans", ends, limit, REFERENCE, line={"dash": "dash"}, hoverinfo="skip"))
    unit = "time a scan [ms]" if width == 1 else f"time a scan, mean of {width} [ms]"
    return figure(traces, 340, xaxis=axis("scan"), yaxis=axis(unit, rangemode="tozero"), hovermode="x unified")


def step_figure(findings: Findings) -> Figure:
    """Plot the errors of steps over time, before and after the residual, on logarithmic axes."""
    traces: list[Trace] = []
    for colour, (name, (times, errors)) in zip(COLOURS[1::-1], findings.step_errors.items(), strict=False):
        sizes = np.linalg.norm(errors[:, 3:], axis=1), np.degrees(np.linalg.norm(errors[:, :3], axis=1))
        for k, size in enumerate(sizes):
            kept = thinned(len(size))
            trace = line(name, times[kept], np.maximum(size[kept], 1e-9), colour, mode="markers")
            trace["marker"] = {"size": 3, "color": colour, "opacity": 0.6}
            trace |= {"legendgroup": name, "showlegend": not k} | ({} if not k else {"xaxis": "x2", "yaxis": "y2"})
            traces.append(trace)
    layout = {
        "xaxis": axis("time [s]", domain=[0, 0.46]),
        "yaxis": axis("translation error [m]", type="log", exponentformat="none"),
        "xaxis2": axis("time [s]", domain=[0.56, 1], anchor="y2"),
        "yaxis2": axis("rotation error [°]", type="log", exponentformat="none", anchor="x2"),
    }
    return figure(traces, 360, **layout)
