"""``hybridlio simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands.common import INTERRUPTED, Verbose, guarded
from hybridlio.commands.terminal import complain, progress, say
from hybridlio.core.errors import ConfigError


@guarded
def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder to write to.", show_default=False)],
    seconds: Annotated[float | None, typer.Option(help="How long to drive; 60 if nothing else says.")] = None,
    length_m: Annotated[float | None, typer.Option("--length-m", help="How far to drive instead, in metres.")] = None,
    seed: Annotated[int, typer.Option(help="Decides road, town, traffic and noise.")] = 1,
    speed: Annotated[float, typer.Option(help="Cruising speed in m/s.")] = 10.0,
    driving: Annotated[str, typer.Option(help="calm, or hard: brakes late, takes bends fast.")] = "calm",
    scene: Annotated[str, typer.Option(help="town, corridor or field.")] = "town",
    lidar: Annotated[str, typer.Option(help="hdl-64e, 32-beam or 16-beam.")] = "hdl-64e",
    distortion: Annotated[bool, typer.Option("--distortion", help="Let the car move during a sweep.")] = False,
    gps: Annotated[bool, typer.Option("--gps", help="Write GPS fixes too.")] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Come back to streets seen before.")] = False,
    start_at_rest: Annotated[bool, typer.Option("--start-at-rest", help="Stand for two seconds first.")] = False,
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Drive along this trajectory (KITTI or TUM format).")
    ] = None,
    poses_frame: Annotated[
        str, typer.Option("--poses-frame", help="What moves in a KITTI file: camera or lidar.")
    ] = "camera",
    _verbose: Verbose = 0,
) -> None:
    """Simulate a drive through a town, as KITTI raw data: lidar scans, a 100 Hz IMU, exact poses.

    The same options give the same bytes. An interrupted run goes on where it stopped.
    """
    from pydantic import ValidationError

    from hybridlio.datasets.registry import open_sequence
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
        raise ConfigError("; ".join(_complaint(e["loc"], e["msg"]) for e in error.errors())) from None
    try:
        with progress("simulating") as tick:
            drive = write_drive(out, config, tick)
    except KeyboardInterrupt:
        complain("interrupted; the same command goes on where this one stopped")
        raise typer.Exit(INTERRUPTED) from None
    sequence = open_sequence(drive)
    length = f", {sequence.reference.length_m:.1f} m" if sequence.reference is not None else ""
    say(f"{sequence.name}: {len(sequence)} scans{length} in {sequence.duration_s:.1f} s")
    say(f"{drive}")


def _complaint(where: tuple[int | str, ...], message: str) -> str:
    name = str(where[0]) if where else "options"
    option = {"speed_m_s": "speed"}.get(name, name).replace("_", "-")
    return f"--{option}: {message.removeprefix('Value error, ')}"
