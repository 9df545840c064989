"""Charts of drift by length and speed, and of errors against their covariances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridlio.evaluation.charts.plotly import (
    COLOURS,
    LEGEND_BELOW,
    Figure,
    Trace,
    axis,
    figure,
    heading,
    line,
    thinned,
    thinned_peaks,
)
from hybridlio.evaluation.consistency import bounds
from hybridlio.evaluation.drift import Drift, DriftAverage
from hybridlio.evaluation.report_data import TimedConsistency

_AXES = ("roll [°]", "pitch [°]", "yaw [°]", "x, forward [m]", "y, left [m]", "z, up [m]")
_MAX_POINTS = 1500  # of each of six panels


def drift_figure(drifts: Mapping[str, Drift]) -> Figure:
    """Plot drift by segment length and, with more than two bins of speed, by speed."""
    by_speed = {name: drift.by_speed() for name, drift in drifts.items()}
    has_speed = max(map(len, by_speed.values()), default=0) > 2
    rows = [("segment length [m]", {name: drift.by_length() for name, drift in drifts.items()})]
    rows += [("speed [m/s]", by_speed)] if has_speed else []
    traces: list[Trace] = []
    layout: dict[str, Any] = {}
    for k, (title, averages) in enumerate(rows):
        for j, (attribute, unit) in enumerate((("t_rel_percent", "[%]"), ("r_rel_deg_per_100m", "[°/100 m]"))):
            number = 2 * k + j + 1
            suffix = "" if number == 1 else str(number)
            top = 1 - k * 0.56
            layout[f"xaxis{suffix}"] = axis(title, domain=[0.54 * j, 0.46 + 0.54 * j], anchor=f"y{suffix}")
            low = 0.0 if not has_speed else top - 0.44
            layout[f"yaxis{suffix}"] = axis(unit, domain=[low, top], anchor=f"x{suffix}", rangemode="tozero")
            traces += [_average(n, found, attribute, suffix, i) for i, (n, found) in enumerate(averages.items())]
    layout["annotations"] = [heading("translation drift", 0.0), heading("rotation drift", 0.54)]
    return figure(traces, 300 * len(rows) + 60, showlegend=len(drifts) > 1, **_legend_below(layout))


def _legend_below(layout: dict[str, Any]) -> dict[str, Any]:
    return layout | {"legend": LEGEND_BELOW, "margin": {"l": 60, "r": 16, "t": 36, "b": 80}}


def _average(name: str, rows: list[DriftAverage], attribute: str, suffix: str, k: int) -> Trace:
    colour = COLOURS[k % len(COLOURS)]
    trace = line(name, [r.at for r in rows], [getattr(r, attribute) for r in rows], colour, mode="lines+markers")
    trace |= {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": name, "showlegend": not suffix}
    return trace | {"hovertemplate": "%{x:g}: %{y:.3g}"}


def nees_figure(timed: TimedConsistency) -> Figure:
    """Plot NEES over time, of rotations and positions, with the 95 % interval of consistent values."""
    traces: list[Trace] = []
    shapes = []
    for k, name in enumerate(("rotation", "position")):
        result = getattr(timed.consistency, name)
        suffix = "" if not k else "2"
        kept = thinned(len(result.nees))
        points = line(name, timed.times_s[kept], np.maximum(result.nees[kept], 1e-3), COLOURS[0], mode="markers")
        points["marker"] = {"size": 3, "color": COLOURS[0], "opacity": 0.5}
        window = max(1, min(50, len(result.nees) // 10))
        mean = np.convolve(result.nees, np.ones(window) / window, "valid")
        middle = timed.times_s[window // 2 : window // 2 + len(mean)]
        kept = thinned(len(mean))
        smooth = line(f"mean of {window}", middle[kept], mean[kept], COLOURS[5], width=1.5)
        traces += [trace | {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"} for trace in (points, smooth)]
        low, high = bounds(1, result.dimension)
        shapes.append(
            {"type": "rect", "xref": f"x{suffix} domain", "yref": f"y{suffix}", "x0": 0, "x1": 1, "y0": low, "y1": high}
            | {"fillcolor": COLOURS[2], "opacity": 0.15, "line": {"width": 0}, "layer": "below"}
        )
    layout = {
        "xaxis": axis("time [s]", domain=[0, 0.46]),
        "yaxis": axis("NEES / 3", type="log", exponentformat="none"),
        "xaxis2": axis("time [s]", domain=[0.54, 1], anchor="y2"),
        "yaxis2": axis("", type="log", exponentformat="none", anchor="x2"),
        "annotations": [heading("rotation", 0.0), heading("position", 0.54)],
    }
    return figure(traces, 320, shapes=shapes, showlegend=False, **layout)


def sigma_figure(timed: TimedConsistency) -> Figure:
    """Plot errors over time for each axis, with ±3σ by the covariances."""
    traces: list[Trace] = []
    layout: dict[str, Any] = {"annotations": []}
    for k, label in enumerate(_AXES):
        scale = np.degrees(1.0) if k < 3 else 1.0
        error, sigma = timed.consistency.errors[:, k] * scale, 3 * timed.consistency.sigmas[:, k] * scale
        suffix = "" if not k else str(k + 1)
        place = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "showlegend": False, "hoverinfo": "skip"}
        even, peaks = thinned(len(error), _MAX_POINTS), thinned_peaks(error, _MAX_POINTS)
        band = np.r_[sigma[even], -sigma[even][::-1]]
        around = np.r_[timed.times_s[even], timed.times_s[even][::-1]]
        fill = {"fill": "toself", "fillcolor": "rgba(86,180,233,0.3)"}
        traces.append(line("3σ", around, band, COLOURS[4], width=0, **fill) | place)
        traces.append(line(label, timed.times_s[peaks], error[peaks], COLOURS[0], width=1) | place)
        column, row = k % 3, k // 3
        left, top = column * 0.345, 1 - row * 0.56
        layout[f"xaxis{suffix}"] = axis("time [s]" if row else "", domain=[left, left + 0.31], anchor=f"y{suffix}")
        limit = 1.15 * max(float(np.quantile(sigma, 0.98)), float(np.quantile(np.abs(error), 0.995)), 1e-12)
        layout[f"yaxis{suffix}"] = axis("", domain=[top - 0.44, top], anchor=f"x{suffix}", range=[-limit, limit])
        outside = float(np.mean(np.abs(error) > sigma))
        layout["annotations"].append(heading(f"{label} · {outside:.1%} outside 3σ", left, top))
    return figure(traces, 480, **layout)
