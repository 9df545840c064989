"""Parts of Plotly figures: numbers in compact form, traces, axes, and the library itself.

A figure is a dictionary with ``data`` (traces) and ``layout``: https://plotly.com/javascript/reference/. Colours are
from Okabe and Ito's palette for colour-blind readers; nothing is shown by colour alone. Text and grid are of a grey
that is readable on a light and on a dark page.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from importlib import resources
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Index

Figure: TypeAlias = dict[str, Any]
Trace: TypeAlias = dict[str, Any]

REFERENCE, BAD, DOUBTFUL, LOOP = "#888888", "#D55E00", "#E69F00", "#009E73"
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
_INK, _GRID = "#808080", "rgba(128,128,128,0.25)"
LEGEND_ABOVE = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0}
LEGEND_BELOW = {"orientation": "h", "y": 0.0, "yref": "container", "yanchor": "bottom", "x": 0}
MAX_POINTS = 4000  # of a line; more are not told apart on a screen, and make hovering slow


def numbers(values: ArrayLike) -> dict[str, str]:
    """Return an array as Plotly takes binary data: float32, which is 1 mm at 10 km."""
    array = np.ascontiguousarray(values, dtype="<f4")
    out = {"dtype": "f4", "bdata": base64.b64encode(array.tobytes()).decode()}
    return out if array.ndim == 1 else out | {"shape": ",".join(map(str, array.shape))}


def thinned(count: int, limit: int = MAX_POINTS) -> Index:
    """Return at most ``limit`` evenly spaced indices below ``count``, with the first and the last."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))


def thinned_peaks(values: ArrayLike, limit: int = MAX_POINTS) -> Index:
    """Return at most ``limit`` indices of values ``(N,)`` that keep the least and the largest of every stretch."""
    values = np.asarray(values, dtype=np.float64)
    if len(values) <= limit:
        return np.arange(len(values))
    stretches = np.array_split(np.arange(len(values)), limit // 2)
    ends = [(s[np.nanargmin(values[s])], s[np.nanargmax(values[s])]) for s in stretches if np.isfinite(values[s]).any()]
    return np.unique(np.array(ends, dtype=np.int64))


def line(name: str, x: ArrayLike, y: ArrayLike, colour: str, **more: Any) -> Trace:
    """Return a line trace."""
    style = {"color": colour, "width": more.pop("width", 1.8)} | more.pop("line", {})
    return {"type": "scatter", "mode": "lines", "name": name, "x": numbers(x), "y": numbers(y), "line": style} | more


def dots(name: str, x: ArrayLike, y: ArrayLike, colour: str, **more: Any) -> Trace:
    """Return a trace of markers."""
    style = {"color": colour, "size": more.pop("size", 4), "symbol": more.pop("symbol", "circle")}
    style |= more.pop("marker", {})
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": numbers(x),
        "y": numbers(y),
        "marker": style,
    } | more


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """Return an axis; ``more`` adds to it."""
    return {"title": {"text": title}, "gridcolor": _GRID, "zeroline": False, "linecolor": _GRID} | more


def figure(traces: list[Trace], height: int, **layout: Any) -> Figure:
    """Return a figure of a height in pixels on a transparent ground."""
    base: Mapping[str, Any] = {
        "height": height,
        "margin": {"l": 60, "r": 16, "t": 36, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": _INK, "size": 12, "family": "system-ui, -apple-system, 'Segoe UI', Arial, sans-serif"},
        "hovermode": "closest",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": _INK},
        "legend": LEGEND_ABOVE,
        "xaxis": axis(),
        "yaxis": axis(),
    }
    return {"data": traces, "layout": {**base, **layout}}


def heading(text: str, x: float, y: float = 1.0) -> dict[str, Any]:
    """Return the title of a panel whose upper left corner is at ``x``, ``y``, shares of the figure."""
    return {
        "text": f"<b>{text}</b>",
        "x": x,
        "y": y,
        "xref": "paper",
        "yref": "paper",
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
    }


def packed_library() -> str:
    """Return Plotly's JavaScript, compressed by gzip, in base64; a browser unpacks it (DecompressionStream)."""
    source = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, 6, mtime=0)).decode()
