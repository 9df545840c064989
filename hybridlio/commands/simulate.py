"""``hybridlio simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands.common import INTERRUPTED, Verbose, guarded
from hybridlio.commands.terminal import print_message, print_result, progress
from hybridlio.core.errors import ConfigError


@guarded
def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder to write to.", show_default=False)],
    seconds: Annotated[float | None, typer.Option(help="Duration; default 60, or as long as --length-m takes.")] = None,
    length_m: Annotated[
        float | None, typer.Option("--length-m", help="Length of the path in metres, instead of --seconds.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of road, town, traffic and noise.")] = 1,
    speed: Annotated[float, typer.Option(help="Cruising speed in m/s.")] = 10.0,
    driving: Annotated[str, typer.Option(help="calm, or hard: brakes late and takes bends fast.")] = "calm",
    scene: Annotated[str, typer.Option(help="town, corridor or field.")] = "town",
    lidar: Annotated[str, typer.Option(help="hdl-64e, 32-beam or 16-beam.")] = "hdl-64e",
    distortion: Annotated[
        bool, typer.Option("--distortion", help="Let the vehicle move during each sweep, which distorts the scans.")
    ] = False,
    gps: Annotated[bool, typer.Option("--gps", help="Also write GPS fixes.")] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Drive through the same streets again.")] = False,
    start_at_rest: Annotated[bool, typer.Option("--start-at-rest", help="Stand still for the first 2 s.")] = False,
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Drive along this trajectory (KITTI or TUM format).")
    ] = None,
    poses_frame: Annotated[
        str, typer.Option("--poses-frame", help="The frame whose poses a KITTI file holds: camera or lidar.")
    ] = "camera",
    _verbosity: Verbose = 0,
) -> None:
    """Simulate a drive and write it as KITTI raw data: lidar scans, a 100 Hz IMU and exact poses.

    The same options give the same files to the last byte. The same command resumes an interrupted simulation.
    """
    from pydantic import ValidationError

    from hybridlio.datasets.protection import check_output
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.runs.own_files import RUN
    from hybridlio.runs.whole_folder import held
    from hybridlio.simulation import SimulationConfig
    from hybridlio.simulation import simulate as write_drive

    values = {
        "seconds": seconds, "length_m": length_m, "seed": seed, "speed_m_s": speed, "scene": scene, "lidar": lidar,
        "driving": driving, "motion_distortion": distortion, "gps": gps, "loops": loops,
        "start_moving": not start_at_rest, "poses": poses, "poses_frame": poses_frame,
    }  # fmt: skip
    try:
        config = SimulationConfig.model_validate(values)
    except ValidationError as error:
        raise ConfigError("; ".join(_describe(e["loc"], e["msg"]) for e in error.errors())) from None
    place = out.expanduser().resolve()
    if run := next((above for above in (place, *place.parents) if RUN.are_in(above)), None):
        raise ConfigError(f"{out} is or lies inside the run folder {run}; choose another folder")
    check_output(out, may_hold=True)
    try:
        with held(place / f"drive-{config.seed:04d}"), progress("simulating") as report:
            drive = write_drive(out, config, report)
    except KeyboardInterrupt:
        print_message("interrupted; the same command resumes the simulation")
        raise typer.Exit(INTERRUPTED) from None
    sequence = open_sequence(drive)
    length = f", {sequence.reference.length_m:.1f} m" if sequence.reference is not None else ""
    print_result(f"{sequence.name}: {len(sequence)} scans{length} in {sequence.duration_s:.1f} s")
    print_result(f"{drive}")


def _describe(place: tuple[int | str, ...], message: str) -> str:
    name = str(place[0]) if place else "options"
    option = {"speed_m_s": "speed"}.get(name, name).replace("_", "-")
    return f"--{option}: {message.removeprefix('Value error, ')}"
