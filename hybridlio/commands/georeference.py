"""``hybridlio georeference``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.gps_options import Antenna, MaxShift, gps_options
from hybridlio.commands.terminal import complain, say
from hybridlio.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from hybridlio.core.geodesy import GeodeticPoint


@guarded
def georeference(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="A run folder that `hybridlio odometry` or `hybridlio smooth` made.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Where to write; by default into RUN.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Where on Earth the fixes' local frame has its origin (degrees, metres), if they do not say.",
        ),
    ] = None,
    antenna: Antenna = None,
    max_shift: MaxShift = None,
    _verbose: Verbose = 0,
) -> None:
    """Place a run on its GPS fixes as a whole, without bending it, and write it as CSV, GeoJSON and TUM."""
    from hybridlio.record.record import Record
    from hybridlio.runs.folder import RECORD, read_run
    from hybridlio.smoothing.georeference import georeference as place
    from hybridlio.smoothing.georeference import write_georeferenced

    stored = read_run(run)
    path = next((p for p in (run / RECORD, run.parent / RECORD) if p.is_file()), None)
    if path is None:
        raise DataError(f"{run}: neither it nor the folder above has {RECORD}, which holds the fixes")
    record, options = Record.load(path), gps_options(antenna, max_shift)
    placed = place(
        record, stored.trajectory, antenna_m=options.antenna_m, max_shift_s=options.max_shift_s, origin=_origin(origin)
    )
    fit = placed.alignment
    say(
        f"{stored.metrics['sequence']}: {int(fit.inliers.sum())} of {len(fit.used)} fixes agree, {fit.rmse_m:.2f} m "
        f"RMSE, clocks {1e3 * fit.shift_s:.0f} ± {1e3 * fit.shift_sigma_s:.0f} ms apart"
    )
    for written in write_georeferenced(run if out is None else out, placed):
        say(f"wrote   {written}")
    if placed.origin is None:
        complain("warning: the fixes do not say where on Earth they are; give --origin for latitudes", "yellow")


def _origin(text: str | None) -> GeodeticPoint | None:
    from hybridlio.core.geodesy import check_geodetic

    if text is None:
        return None
    try:
        latitude, longitude, height = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--origin {text!r}: give latitude, longitude (degrees) and height (metres)") from None
    return check_geodetic(latitude, longitude, height, f"--origin {text!r}, latitude first")
