"""The picture of a run's trajectory, by matplotlib, without changing global state.

Colours are from Okabe and Ito's palette for colour-blind readers; nothing is shown by colour alone.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import travelled_m
from hybridlio.evaluation.report_data import DrawnPath

if TYPE_CHECKING:
    from matplotlib.axes import Axes


REFERENCE = "#444444"
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000")
BAD = "#D55E00"
LOOP = "#009E73"
_WIDTH_IN = 11.0  # text of 10 points stays readable at the report's width of 70 rem
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "figure.constrained_layout.h_pad": 0.09,
}


def to_png(figure: Figure, dpi: int = 160) -> bytes:
    """Return the figure as a PNG file."""
    buffer = io.BytesIO()
    with rc_context(_STYLE):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def trajectory_figure(
    paths: Mapping[str, DrawnPath],
    reference_m: Array | None = None,
    bridged_m: Array | None = None,
    loops_m: Array | None = None,
) -> Figure:
    """Plot the paths from above, their heights and, with a reference, their distances from it.

    Args:
        paths: by name, the main one first, in the reference's frame.
        reference_m: ``(R, 3)`` positions of the ground truth.
        bridged_m: ``(B, 3)`` positions at scans that could not be used.
        loops_m: ``(L, 2, 3)`` positions of the two ends of each loop closure.
    """
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 5.4), layout="constrained")
        right = ["height", "error"] if reference_m is not None else ["height", "height"]
        axes = figure.subplot_mosaic([["above", right[0]], ["above", right[1]]], width_ratios=[1.2, 1])
        _above(axes["above"], paths, reference_m, bridged_m, loops_m)
        if reference_m is not None:
            axes["height"].plot(travelled_m(reference_m), reference_m[:, 2], color=REFERENCE, lw=4, alpha=0.45)
            axes["error"].set(title="Distance from the reference", xlabel="distance travelled [m]", ylabel="[m]")
        for k, path in enumerate(paths.values()):
            style = _line(k)
            axes["height"].plot(travelled_m(path.positions_m), path.positions_m[:, 2], **style)
            if reference_m is not None:
                axes["error"].plot(path.travelled_m, path.error_m, **style)
        if reference_m is not None:
            axes["error"].set_ylim(bottom=0)
        axes["height"].set(title="Height", xlabel="distance travelled [m]", ylabel="z [m]")
        _at_least(axes["height"], 1.0)
    return figure


def _above(
    ax: Axes,
    paths: Mapping[str, DrawnPath],
    reference_m: Array | None,
    bridged_m: Array | None,
    loops_m: Array | None,
) -> None:
    if reference_m is not None:
        ax.plot(*reference_m[:, :2].T, color=REFERENCE, lw=4, alpha=0.45, label="reference")
    for k, (name, path) in enumerate(paths.items()):
        x, y = path.positions_m[:, :2].T
        ax.plot(x, y, label=name, zorder=3 - 0.1 * k, **_line(k))
    main = next(iter(paths.values())).positions_m
    ax.plot(*main[0, :2], "o", color="white", mec="black", ms=8, zorder=4, label="start")
    ax.plot(*main[-1, :2], "s", color="black", ms=7, zorder=4, label="end")
    if bridged_m is not None and len(bridged_m):
        ax.plot(*bridged_m[:, :2].T, "x", color=BAD, ms=7, mew=2, zorder=5, label="bridged scan")
    if loops_m is not None and len(loops_m):
        _draw_loops(ax, loops_m)
    ax.set(title="From above", xlabel="x [m]", ylabel="y [m]")
    _at_least(ax, 1.0)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(loc="best")


def _draw_loops(ax: Axes, loops_m: Array) -> None:
    """Draw a dot at both ends, which may coincide, and a line between them."""
    joined = np.concatenate([loops_m[:, :, :2], np.full((len(loops_m), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    ax.plot(*joined.T, "-o", color=LOOP, ms=3.5, lw=1.2, zorder=3.5, label="loop closure")


def _line(k: int) -> dict[str, Any]:
    return {"color": COLOURS[k % len(COLOURS)], "ls": ("-", "--", "-.", ":")[k % 4]}


def _at_least(ax: Axes, span: float) -> None:
    """Widen the axes to at least ``span``, so that noise is not magnified."""
    for get, put in ((ax.get_xlim, ax.set_xlim), (ax.get_ylim, ax.set_ylim)):
        low, high = get()
        if high - low < span:
            put((low + high - span) / 2, (low + high + span) / 2)
