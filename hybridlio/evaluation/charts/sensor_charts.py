"""Charts of the sensors: biases of the IMU, and residuals of the GPS fixes."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.evaluation.charts.plotly import COLOURS, Figure, Trace, axis, dots, figure, line, thinned
from hybridlio.evaluation.report_data import ReportData

_SIGMAS_95 = 1.96  # of one axis: 95 % of a normal distribution
_PANELS = (("accelerometer bias [m/s²]", 1.0), ("gyroscope bias [°/s]", float(np.degrees(1.0))))


def bias_figure(data: ReportData) -> Figure:
    """Plot the biases of accelerometer and gyroscope over time, with 95 % bands where they are known."""
    assert data.biases is not None
    kept, traces = thinned(len(data.biases)), []
    times = data.estimate.times_s[kept]
    for panel, (_, scale) in enumerate(_PANELS):
        place = {} if not panel else {"xaxis": "x2", "yaxis": "y2"}
        for k, (name, colour) in enumerate(zip("xyz", COLOURS, strict=False)):
            values = scale * data.biases[kept, 3 * panel + k]
            more = {"legendgroup": name, **place}
            if data.bias_sigmas is not None and np.isfinite(data.bias_sigmas[kept, 3 * panel + k]).any():
                half = _SIGMAS_95 * scale * data.bias_sigmas[kept, 3 * panel + k]
                traces += _band(name, times, values, half, colour, more)
            traces.append(line(name, times, values, colour, showlegend=not panel, **more))
    layout = {
        "xaxis": axis("time [s]", domain=[0, 0.46]),
        "yaxis": axis(_PANELS[0][0]),
        "xaxis2": axis("time [s]", domain=[0.56, 1], anchor="y2"),
        "yaxis2": axis(_PANELS[1][0], anchor="x2"),
    }
    return figure(traces, 340, hovermode="x unified", **layout)


def _band(name: str, times_s: Array, values: Array, half: Array, colour: str, more: dict[str, str]) -> list[Trace]:
    """Return both ends of a band, between which it is filled."""
    known = np.isfinite(half) & np.isfinite(values)
    shared: dict[str, Any] = {"width": 0, "hoverinfo": "skip", "showlegend": False, **more}
    low = line(f"{name}, lower end", times_s[known], (values - half)[known], colour, **shared)
    high = line(f"{name}, upper end", times_s[known], (values + half)[known], colour, **shared)
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return [low, high | {"fill": "tonexty", "fillcolor": f"rgba({red},{green},{blue},0.15)"}]


def fix_figure(data: ReportData) -> Figure:
    """Plot the residuals of the GPS fixes over time, antenna minus fix."""
    assert data.fix_times_s is not None
    assert data.fix_residuals_m is not None
    traces = []
    for k, (name, colour) in enumerate(zip(("east", "north", "up"), COLOURS, strict=False)):
        residuals = data.fix_residuals_m[:, k]
        traces.append(dots(name, data.fix_times_s, residuals, colour, size=5))
    return figure(traces, 300, xaxis=axis("time [s]"), yaxis=axis("antenna minus fix [m]"), hovermode="x unified")
