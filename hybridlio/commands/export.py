"""``hybridlio export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.terminal import print_message, print_result, progress
from hybridlio.core.tables import counted


@guarded
def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder, smoothed or not.", show_default=False)],
    mcap: Annotated[
        Path, typer.Option("--mcap", metavar="FILE.mcap", help="The file to write, for Foxglove.", show_default=False)
    ],
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DATA", help="The recording, if it is not where the run found it.")
    ] = None,
    overwrite: common.Overwrite = False,
    scans: Annotated[
        bool, typer.Option("--scans", help="Write the points of every scan too, read from the recording.")
    ] = False,
    _verbosity: common.Verbose = 0,
) -> None:
    """Write a run as an MCAP file for Foxglove: transforms, poses with covariance, paths, map, diagnostics, GPS, loops.

    The run folder itself holds poses in the formats of TUM and KITTI; `georeference` writes GeoJSON, `map` clouds.
    """
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.viewing.mcap_export import check_mcap_path, export_mcap

    check_mcap_path(mcap)
    check_new_file(mcap, overwrite, *([] if data is None else [data]))
    with progress("export") as reported:
        scene = export_mcap(run, mcap, data=data, scans=scans, progress=reported)
    for note in scene.left_out:
        print_message(note, "yellow")
    print_result(f"{scene.name}: {counted(len(scene.scans), 'scan')}")
    print_result(f"mcap    {mcap}")
