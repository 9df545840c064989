"""The report's plots. Each function takes arrays and returns a matplotlib figure, without changing global state.

Colours are from Okabe and Ito's palette for colour-blind readers; nothing is shown by colour alone.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import travelled_m
from hybridlio.evaluation.consistency import Anees, PoseConsistency, bounds
from hybridlio.evaluation.drift import Drift, DriftAverage
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


def drift_figure(drifts: Mapping[str, Drift]) -> Figure:
    """Plot drift by segment length, and by speed if there are more than two speed bins."""
    with rc_context(_STYLE):
        by_speed = {name: drift.by_speed() for name, drift in drifts.items()}
        rows = 2 if max(map(len, by_speed.values()), default=0) > 2 else 1
        figure = Figure(figsize=(_WIDTH_IN, 0.4 + 2.8 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False)
        _drift_row(axes[0], {name: drift.by_length() for name, drift in drifts.items()}, "segment length [m]")
        if rows == 2:
            _drift_row(axes[1], by_speed, "speed [m/s]")
        if len(drifts) > 1:
            figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=min(len(drifts), 4))
    return figure


def step_error_figure(errors: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Plot the errors of steps over time, and their cumulative distribution.

    Args:
        errors: by name, times ``(M,)`` in seconds and errors ``(M, 6)`` in rad and m, rotation first.
    """
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 5.4), layout="constrained")
        axes = figure.subplots(2, 2, width_ratios=[1.7, 1], sharey="row")
        for colour, (name, (times, error)) in zip(COLOURS[1::-1], errors.items(), strict=False):
            sizes = np.linalg.norm(error[:, 3:], axis=1), np.degrees(np.linalg.norm(error[:, :3], axis=1))
            for row, size in zip(axes, sizes, strict=True):
                positive = np.maximum(size, 1e-9)
                row[0].plot(times, positive, ".", ms=3.5, alpha=0.6, color=colour, mec="none")
                share = np.arange(1, len(size) + 1) / len(size)
                row[1].plot(share, np.sort(positive), color=colour, label=f"{name}: median {_short(np.median(size))}")
        for row, title, unit in zip(axes, ("Translation", "Rotation"), ("m", "°"), strict=True):
            row[0].set(title=f"{title} error per step", ylabel=f"[{unit}]", yscale="log", xlabel="time [s]")
            row[0].yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
            row[1].set(title="Cumulative distribution", xlabel="share of steps")
            row[1].xaxis.set_major_formatter(PercentFormatter(1.0))
            row[1].legend(loc="best")
            for text in row[1].get_legend().get_texts():
                text.set_text(f"{text.get_text()} {unit}")
    return figure


def timing_figure(timings_s: Mapping[str, Array], period_s: float | None = None) -> Figure:
    """Plot the processing time: stages stacked over the scans, and the median and 99th percentile of each stage.

    Args:
        timings_s: by stage, ``(M,)`` seconds per scan.
        period_s: time between scans, drawn as the limit of real time.
    """
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 3.6), layout="constrained")
        stacked, bars = figure.subplots(1, 2, width_ratios=[1.5, 1])
        scans = min(map(len, timings_s.values()))
        width = max(1, scans // 150)
        bins = np.arange(0, scans - width + 1, width)
        means = [1e3 * np.add.reduceat(t[: bins[-1] + width], bins) / width for t in timings_s.values()]
        colours = [COLOURS[k % len(COLOURS)] for k in range(len(timings_s))]
        stacked.stackplot(bins + width / 2, means, colors=colours, linewidth=0, step="mid" if len(bins) < 40 else None)
        totals = np.sum([t[:scans] for t in timings_s.values()], axis=0)
        _real_time(stacked, period_s, float(np.max(np.sum(means, axis=0))))
        stacked.set(title=f"Time per scan{f' (mean of {width})' if width > 1 else ''}", xlabel="scan", ylabel="[ms]")
        stacked.set_xlim(0, scans)
        stacked.set_ylim(bottom=0)
        _timing_bars(bars, {**timings_s, "all": totals}, [*colours, REFERENCE])
    return figure


def nees_figure(times_s: Array, consistency: PoseConsistency) -> Figure:
    """Plot NEES over time, of rotations and positions, with the 95 % interval of consistent values."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 3.7), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, name in zip(axes, ("rotation", "position"), strict=True):
            _nees(ax, times_s, getattr(consistency, name))
            ax.set(title=name.capitalize(), xlabel="time [s]", yscale="log")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, markerscale=2)
        axes[0].set_ylabel("NEES / 3")
        axes[0].yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        lowest = max(
            1e-3, min(float(np.quantile(getattr(consistency, n).nees, 0.01)) for n in ("rotation", "position"))
        )
        axes[0].set_ylim(bottom=min(lowest, 0.05))
    return figure


def sigma_figure(times_s: Array, consistency: PoseConsistency) -> Figure:
    """Plot errors over time for each axis, with ±3σ by the covariances."""
    labels = ("roll", "pitch", "yaw", "x, forward", "y, left", "z, up")
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 4.6), layout="constrained")
        axes = figure.subplots(2, 3, sharex=True)
        for k, (ax, label) in enumerate(zip(axes.flat, labels, strict=True)):
            scale = np.degrees(1.0) if k < 3 else 1.0
            error, sigma = consistency.errors[:, k] * scale, 3 * consistency.sigmas[:, k] * scale
            ax.fill_between(times_s, -sigma, sigma, color=COLOURS[4], alpha=0.3, lw=0)
            ax.plot(times_s, error, color=COLOURS[0], lw=0.9)
            outside = float(np.mean(np.abs(error) > sigma))
            ax.set_title(f"{label} [{'°' if k < 3 else 'm'}] · {outside:.1%} outside 3σ")
            limit = 1.15 * max(float(np.quantile(sigma, 0.98)), float(np.quantile(np.abs(error), 0.995)), 1e-12)
            ax.set_ylim(-limit, limit)
        for ax in axes[1]:
            ax.set_xlabel("time [s]")
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


def _drift_row(axes: NDArray[np.object_], averages: Mapping[str, list[DriftAverage]], xlabel: str) -> None:
    for k, (name, rows) in enumerate(averages.items()):
        style = {"color": COLOURS[k % len(COLOURS)], "marker": "os^Dv"[k % 5], "label": name}
        at = [row.at for row in rows]
        axes[0].plot(at, [row.t_rel_percent for row in rows], **style)
        axes[1].plot(at, [row.r_rel_deg_per_100m for row in rows], **style)
    for ax, title, unit in zip(axes, ("Translation drift", "Rotation drift"), ("%", "°/100 m"), strict=True):
        ax.set(title=title, xlabel=xlabel, ylabel=f"[{unit}]")
        highest = max((float(np.max(line.get_ydata())) for line in ax.lines), default=0.0)
        ax.set_ylim(0, 1.12 * max(highest, 1e-3))


def _real_time(ax: Axes, period_s: float | None, highest_ms: float) -> None:
    if period_s is not None and 1e3 * period_s < 4 * highest_ms:
        ax.axhline(1e3 * period_s, color="black", ls="--", lw=1)
        ax.annotate(
            "time between scans", (1, 1e3 * period_s), xycoords=("axes fraction", "data"), ha="right", va="bottom"
        )


def _timing_bars(ax: Axes, timings_s: Mapping[str, Array], colours: list[str]) -> None:
    medians = [1e3 * float(np.median(t)) for t in timings_s.values()]
    p99s = [1e3 * float(np.quantile(t, 0.99)) for t in timings_s.values()]
    rows = np.arange(len(medians))[::-1]
    ax.barh(rows, medians, color=colours, height=0.62)
    ax.hlines(rows, medians, p99s, color="#222222", lw=1.2)
    ax.plot(p99s, rows, "|", color="#222222", ms=9, mew=1.6)
    for row, median, p99 in zip(rows, medians, p99s, strict=True):
        ax.annotate(_short(median), (max(median, p99), row), xytext=(6, 0), textcoords="offset points", va="center")
    ax.set_yticks(rows, list(timings_s))
    ax.set_xlim(0, 1.18 * max(*p99s, *medians, 1e-6))
    ax.grid(visible=False, axis="y")
    ax.set(title="Median (bar) and 99th percentile (tick)", xlabel="[ms]")


def _nees(ax: Axes, times_s: Array, result: Anees) -> None:
    window = max(1, min(50, len(result.nees) // 10))
    low, high = bounds(1, result.dimension)
    ax.axhspan(low, high, color="#009E73", alpha=0.13, lw=0, label="95 % interval if consistent")
    ax.axhline(1, color="#00664b", lw=1, ls="--")
    ax.plot(times_s, np.maximum(result.nees, 1e-9), ".", ms=4, alpha=0.5, color=COLOURS[0], mec="none", label="step")
    mean = np.convolve(result.nees, np.ones(window) / window, "valid")
    middle = times_s[window // 2 : window // 2 + len(mean)]
    ax.plot(middle, mean, color="black", lw=1.3, label=f"mean of {window}")


def _at_least(ax: Axes, span: float) -> None:
    """Widen the axes to at least ``span``, so that noise is not magnified."""
    for get, put in ((ax.get_xlim, ax.set_xlim), (ax.get_ylim, ax.set_ylim)):
        low, high = get()
        if high - low < span:
            put((low + high - span) / 2, (low + high + span) / 2)


def _short(value: float | np.floating) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
