"""Charts of the path: from above on the points of the scans, and in space."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import travelled_m
from hybridlio.evaluation.charts.plotly import (
    BAD,
    COLOURS,
    DOUBTFUL,
    LEGEND_BELOW,
    LOOP,
    REFERENCE,
    Figure,
    Trace,
    axis,
    dots,
    figure,
    line,
    numbers,
    thinned,
)
from hybridlio.evaluation.report_data import DrawnPath, Findings, ReportData

_MAX_COLOURED = 2500  # markers of the path; each is an element of the page
_ELLIPSES = 25  # along the path; more overlap
_PROBABILITY_95 = 2.4477  # radius in standard deviations of the 95 % ellipse of two dimensions: sqrt(chi2.ppf(.95, 2))
_PICTURE_PIXELS = 1400  # longer side of the picture of the points
_MAX_POINTS_3D = 20_000
_POINT_TAILS = (0.02, 0.98)  # quantiles of height at the ends of the points' shades


@dataclass(frozen=True, eq=False)
class PathValues:
    """What is known at each drawn pose of the estimate, ``(M,)`` each.

    Attributes:
        times_s: since the first pose.
        distance_m: travelled.
        speed_m_s: mean over the steps before and after.
        sigma_m: of the position, root of the sum of the three variances; None without covariances.
        error_m: distance from the reference, aligned at the start; None without a reference.
    """

    times_s: Array
    distance_m: Array
    speed_m_s: Array
    sigma_m: Array | None
    error_m: Array | None


def path_values(data: ReportData, path: DrawnPath) -> PathValues:
    """Return the values at the drawn poses of the estimate."""
    estimate, rows = data.estimate, path.rows
    distance = travelled_m(estimate.poses[:, :3, 3])
    speed = np.gradient(distance, estimate.times_s) if len(estimate) > 1 else np.zeros(1)
    sigma = None
    if estimate.covariances is not None:
        sigma = np.sqrt(np.einsum("nii->n", estimate.covariances[rows, 3:, 3:]))
    error = path.error_m if len(path.error_m) else None
    return PathValues(estimate.times_s[rows], distance[rows], speed[rows], sigma, error)


def map_figure(data: ReportData, findings: Findings) -> Figure:
    """Plot all paths from above; the estimate is coloured by its uncertainty, error, speed or time."""
    own = findings.paths[data.estimate_name]
    values = path_values(data, own)
    traces = []
    if data.reference is not None and findings.evaluations:
        at = data.reference.poses[thinned(len(data.reference)), :3, 3]
        traces.append(line("reference", at[:, 0], at[:, 1], REFERENCE, width=5, opacity=0.6, hoverinfo="skip"))
    for colour, (name, path) in zip(COLOURS[1:], list(findings.paths.items())[1:], strict=False):
        at = path.positions_m[thinned(len(path.positions_m))]
        traces.append(line(name, at[:, 0], at[:, 1], colour, line={"dash": "dash"}, hoverinfo="skip"))
    coloured, menu = _coloured(data.estimate_name, own, values, len(traces))
    traces += [coloured, *_ellipses(data, own), *_marks(data, own)]
    layout: dict[str, Any] = {
        "xaxis": axis("x [m]"),
        "yaxis": axis("y [m]", scaleanchor="x", scaleratio=1),
        "dragmode": "pan",
        "updatemenus": [menu],
        "margin": {"l": 56, "r": 16, "t": 50, "b": 110},
        "legend": LEGEND_BELOW,
    }
    if data.map_points is not None and len(data.map_points):
        layout["images"] = [_picture(_in_reference_frame(own, data.map_points))]
    return figure(traces, 660, **layout)


def space_figure(data: ReportData, findings: Findings) -> Figure:
    """Plot the paths and a part of the scans' points in space."""
    own = findings.paths[data.estimate_name]
    traces: list[Trace] = []
    if data.map_points is not None and len(data.map_points):
        points = _in_reference_frame(own, data.map_points[thinned(len(data.map_points), _MAX_POINTS_3D)])
        low, high = np.quantile(points[:, 2], _POINT_TAILS)
        marker = {"size": 1.2, "color": numbers(points[:, 2]), "colorscale": "Viridis", "cmin": low, "cmax": high}
        traces.append(_in_space("points", points, mode="markers", marker=marker))
    if data.reference is not None and findings.evaluations:
        at = data.reference.poses[thinned(len(data.reference)), :3, 3]
        traces.append(_in_space("reference", at, mode="lines", line={"color": REFERENCE, "width": 7}))
    for colour, (name, path) in zip(COLOURS, findings.paths.items(), strict=False):
        at = path.positions_m[thinned(len(path.positions_m))]
        traces.append(_in_space(name, at, mode="lines", line={"color": colour, "width": 4}))
    scene = {"aspectmode": "data", **{f"{a}axis": axis(f"{a} [m]") for a in "xyz"}}
    return figure(traces, 620, scene=scene, margin={"l": 0, "r": 0, "t": 36, "b": 0})


def _in_space(name: str, at: Array, **more: Any) -> Trace:
    xyz = {a: numbers(at[:, k]) for k, a in enumerate("xyz")}
    return {"type": "scatter3d", "name": name, "hoverinfo": "skip" if name == "points" else "name", **xyz, **more}


def _coloured(name: str, path: DrawnPath, values: PathValues, position: int) -> tuple[Trace, dict[str, Any]]:
    """Return the estimate's trace, and the menu that chooses what colours it."""
    kept = thinned(len(path.rows), _MAX_COLOURED)
    columns = {"σ [m]": values.sigma_m, "error [m]": values.error_m, "speed [m/s]": values.speed_m_s}
    columns["time [s]"] = values.times_s
    known = {label: column[kept] for label, column in columns.items() if column is not None}
    buttons = [
        {
            "label": f"colour: {label}",
            "method": "restyle",
            "args": [{"marker.color": [numbers(c)], "marker.colorbar.title.text": [label]}, [position]],
        }
        for label, c in known.items()
    ]
    first = next(iter(known))
    at = path.positions_m[kept]
    hover = ["time %{customdata[0]:.1f} s", "distance %{customdata[1]:.1f} m", "speed %{customdata[2]:.2f} m/s"]
    custom = [values.times_s[kept], values.distance_m[kept], values.speed_m_s[kept]]
    for label, column in (("σ", values.sigma_m), ("error", values.error_m)):
        if column is not None:
            hover.append(f"{label} %{{customdata[{len(custom)}]:.3f}} m")
            custom.append(column[kept])
    bar = {"title": {"text": first, "side": "right"}, "thickness": 12, "len": 0.7}
    trace = line(name, at[:, 0], at[:, 1], COLOURS[0], width=1.5, mode="lines+markers")
    trace["marker"] = {"size": 6, "color": numbers(known[first]), "colorscale": "Viridis", "colorbar": bar}
    trace["customdata"] = numbers(np.column_stack(custom))
    trace["hovertemplate"] = "<br>".join(hover) + "<extra></extra>"
    menu = {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1.02, "yanchor": "bottom", "bgcolor": "#ffffff"}
    menu["font"] = {"color": "#333333"}
    return trace, menu


def _ellipses(data: ReportData, path: DrawnPath) -> list[Trace]:
    """Return the 95 % ellipses of horizontal positions at some poses, as one trace."""
    if data.estimate.covariances is None or len(path.rows) < 2:
        return []
    picked = thinned(len(path.rows), _ELLIPSES)[1:]
    outlines = []
    for k in picked:
        row = path.rows[k]
        R = (path.T_drawn_world @ data.estimate.poses[row])[:3, :3]  # covariances are in the lidar's axes
        covariance = (R @ data.estimate.covariances[row, 3:, 3:] @ R.T)[:2, :2]
        outlines.append(_outline(path.positions_m[k, :2], covariance))
    x, y = np.concatenate(outlines).T
    return [line("95 % of position", x, y, COLOURS[3], width=1.2, hoverinfo="skip")]


def _outline(centre_m: Array, covariance_m2: Array) -> Array:
    """Return the 95 % ellipse ``(34, 2)`` of a horizontal position, with NaN at its end."""
    angle = np.linspace(0, 2 * np.pi, 33)
    values, axes = np.linalg.eigh(covariance_m2)
    half_axes = _PROBABILITY_95 * np.sqrt(np.maximum(values, 0))
    outline = centre_m[:, None] + axes @ (half_axes[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    return np.vstack([outline.T, [np.nan, np.nan]])


def _fix_ellipses(data: ReportData, path: DrawnPath, fixes_m: Array) -> list[Trace]:
    """Return the 95 % ellipses of some GPS fixes ``(F, 3)``, as one trace; none without covariances."""
    if data.fix_covariances_m2 is None:
        return []
    R = path.T_drawn_world[:3, :3]
    picked = thinned(len(fixes_m), _ELLIPSES)
    outlines = [_outline(fixes_m[k, :2], (R @ data.fix_covariances_m2[k] @ R.T)[:2, :2]) for k in picked]
    x, y = np.concatenate(outlines).T
    return [line("95 % of fixes", x, y, COLOURS[4], width=1.0, hoverinfo="skip")]


def _marks(data: ReportData, path: DrawnPath) -> list[Trace]:
    """Return loops, flagged scans, fixes, start and end."""
    out = []
    if data.loops is not None and len(data.loops):
        ends = data.loops[np.isin(data.loops, path.rows).all(axis=1)]
        at = path.positions_m[np.searchsorted(path.rows, ends)][:, :, :2]
        joined = np.concatenate([at, np.full((len(at), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        out.append(line("loop closure", joined[:, 0], joined[:, 1], LOOP, mode="lines+markers", hoverinfo="name"))
    if data.fixes_m is not None and len(data.fixes_m):
        fixes = _in_reference_frame(path, data.fixes_m)
        out += _fix_ellipses(data, path, fixes)
        out.append(dots("GPS fix", fixes[:, 0], fixes[:, 1], COLOURS[3], size=7, symbol="cross-thin-open"))
    for (name, rows), symbol in zip(
        data.flagged.items(), ("x", "diamond-open", "triangle-up", "square-open"), strict=False
    ):
        drawn = np.searchsorted(path.rows, rows[np.isin(rows, path.rows)])
        at = path.positions_m[drawn]
        if len(at):
            scans = [f"scan {row + data.first_scan}: {name}" for row in path.rows[drawn].tolist()]
            colour = BAD if symbol == "x" else DOUBTFUL
            out.append(dots(name, at[:, 0], at[:, 1], colour, size=9, symbol=symbol, text=scans, hoverinfo="text"))
    first_and_last = path.positions_m[[0, -1]]
    out.append(
        dots(
            "start",
            first_and_last[:1, 0],
            first_and_last[:1, 1],
            "#ffffff",
            size=11,
            marker={"line": {"width": 2, "color": "#000"}},
        )
    )
    out.append(
        dots(
            "end",
            first_and_last[1:, 0],
            first_and_last[1:, 1],
            "#000000",
            size=10,
            symbol="square",
            marker={"line": {"width": 1, "color": "#fff"}},
        )
    )
    return out


def _in_reference_frame(path: DrawnPath, points: Array) -> Array:
    return np.asarray(points @ path.T_drawn_world[:3, :3].T + path.T_drawn_world[:3, 3])


def _picture(points: Array) -> dict[str, Any]:
    """Return a picture of points from above, darker where there are more, to lie below the paths."""
    from matplotlib.image import imsave

    low, high = np.quantile(points[:, :2], 0.002, axis=0), np.quantile(points[:, :2], 0.998, axis=0)
    span = np.maximum(high - low, 1.0)
    pixel_m = span.max() / _PICTURE_PIXELS
    size = np.ceil(span / pixel_m).astype(int) + 1
    cells = np.floor((points[:, :2] - low) / pixel_m).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    counts = np.zeros((size[1], size[0]))
    np.add.at(counts, (cells[inside, 1], cells[inside, 0]), 1)
    shade = np.log1p(counts) / max(np.log1p(np.quantile(counts[counts > 0], 0.98)), 1e-9)
    pixels = np.full((*counts.shape, 4), 110, dtype=np.uint8)  # grey, on a light and a dark page
    pixels[..., 3] = np.where(counts > 0, 60 + 150 * np.clip(shade, 0, 1), 0)
    buffer = io.BytesIO()
    imsave(buffer, pixels[::-1], format="png")
    return {
        "source": "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(),
        "xref": "x",
        "yref": "y",
        "x": float(low[0]),
        "y": float(low[1] + size[1] * pixel_m),
        "sizex": float(size[0] * pixel_m),
        "sizey": float(size[1] * pixel_m),
        "sizing": "stretch",
        "layer": "below",
    }
