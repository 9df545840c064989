"""``hybridlio georeference``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Overwrite, Verbose, guarded
from hybridlio.commands.shared.gps_options import Antenna, MaxShift, gps_options
from hybridlio.commands.terminal import print_result, print_warning
from hybridlio.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from hybridlio.core.geodesy import GeodeticPoint


@guarded
def georeference(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="A run folder written by `hybridlio odometry` or `hybridlio smooth`.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="The folder to write to; default RUN.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Origin of the fixes' local frame (degrees, metres), if the recording does not have it.",
        ),
    ] = None,
    antenna: Antenna = None,
    max_shift: MaxShift = None,
    overwrite: Overwrite = False,
    _verbosity: Verbose = 0,
) -> None:
    """Align a run with its GPS fixes by one rigid motion; write it as CSV, GeoJSON and TUM."""
    from hybridlio.datasets.protection import check_new_file, check_output
    from hybridlio.record.record import Record
    from hybridlio.runs.folder import RECORD, read_run
    from hybridlio.smoothing.georeference import FILES, write_georeferenced
    from hybridlio.smoothing.georeference import georeference as place

    folder = run if out is None else out
    check_output(folder)
    for name in FILES:
        check_new_file(folder / name, overwrite)
    stored = read_run(run)
    path = next((p for p in (run / RECORD, run.parent / RECORD) if p.is_file()), None)
    if path is None:
        raise DataError(f"{run}: no {RECORD}, which holds the GPS fixes, in this folder or the one above")
    record, options = Record.load(path), gps_options(antenna, max_shift)
    placed = place(
        record,
        stored.trajectory,
        antenna_m=options.antenna_m,
        max_shift_s=options.max_shift_s,
        origin=_parse_origin(origin),
    )
    fit = placed.alignment
    print_result(
        f"{stored.metrics['sequence']}: {int(fit.inliers.sum())} of {len(fit.used)} fixes are inliers, "
        f"{fit.rmse_m:.2f} m RMSE, clock offset {1e3 * fit.shift_s:.0f} ± {1e3 * fit.shift_sigma_s:.0f} ms"
    )
    written = write_georeferenced(folder, placed)
    for stale in {folder / name for name in FILES} - set(written):
        stale.unlink(missing_ok=True)  # of an alignment whose origin was known
    for path in written:
        print_result(f"wrote   {path}")
    if placed.origin is None:
        print_warning("the fixes have no geodetic origin; give --origin to get latitudes and longitudes")


def _parse_origin(text: str | None) -> GeodeticPoint | None:
    from hybridlio.core.geodesy import check_geodetic

    if text is None:
        return None
    try:
        latitude, longitude, height = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--origin {text!r}: give latitude, longitude (degrees) and height (metres)") from None
    return check_geodetic(latitude, longitude, height, f"--origin {text!r}, latitude first")
