"""``hybridlio simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from hybridlio.commands.common import INTERRUPTED, Verbose, guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_message, print_result, progress
from hybridlio.core.errors import ConfigError

LengthM = Annotated[
    float | None, typer.Option("--length-m", help="Length of the path in metres, instead of --seconds.")
]
DriveSeed = Annotated[
    int | None,
    typer.Option("--drive-seed", help="Drive through the same town again: other traffic, parked cars, noise."),
]
Driving = Annotated[
    str,
    typer.Option(
        metavar="NAME", autocompletion=completion.driving, help="calm, or hard: brakes late and takes bends fast."
    ),
]
Scene = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.scene,
        help="A road: town, corridor or field; or a scene for other platforms: office, "
        "room, stairs, house, warehouse, garage, forest, tunnel, mine or campus.",
    ),
]
Platform = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.platform,
        help="The carrier in those scenes: handheld, quadruped, robot, drone or car; by default the usual one.",
    ),
]
Lidar = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.lidar,
        help="Roads: hdl-64e, 32-beam or 16-beam; else os0, os1, pandar, hdl-64e, vlp-16, mid360, rosette or raster.",
    ),
]
ImuGrade = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.imu,
        help="In those scenes: consumer-mems (default), industrial or tactical.",
    ),
]
Distortion = Annotated[
    bool, typer.Option("--distortion", help="Let the vehicle move during each sweep, which distorts the scans.")
]
Poses = Annotated[Path | None, typer.Option(metavar="FILE", help="Drive along this trajectory (KITTI or TUM format).")]
PosesFrame = Annotated[
    str,
    typer.Option(
        "--poses-frame",
        metavar="NAME",
        autocompletion=completion.poses_frame,
        help="The frame whose poses a KITTI file holds: camera or lidar.",
    ),
]


@guarded
def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder to write to.", show_default=False)],
    seconds: Annotated[float | None, typer.Option(help="Duration; default 60, or as long as --length-m takes.")] = None,
    length_m: LengthM = None,
    seed: Annotated[int, typer.Option(help="Random seed of road, town, traffic and noise.")] = 1,
    drive_seed: DriveSeed = None,
    speed: Annotated[float, typer.Option(help="Cruising speed in m/s.")] = 10.0,
    driving: Driving = "calm",
    scene: Scene = "town",
    platform: Platform = None,
    lidar: Lidar = None,
    imu: ImuGrade = None,
    distortion: Distortion = False,
    gps: Annotated[bool, typer.Option("--gps", help="Also write GPS fixes.")] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Drive through the same streets again.")] = False,
    start_at_rest: Annotated[bool, typer.Option("--start-at-rest", help="Stand still for the first 2 s.")] = False,
    rain: Annotated[float, typer.Option(metavar="MM_H", help="On roads: rate of the rain, up to 300 mm/h.")] = 0.0,
    dust: Annotated[float, typer.Option(metavar="PER_KM", help="On roads: clouds of dust per kilometre.")] = 0.0,
    people: Annotated[int | None, typer.Option(help="In those scenes: people who walk around the sensor.")] = None,
    poses: Poses = None,
    poses_frame: PosesFrame = "camera",
    _verbosity: Verbose = 0,
) -> None:
    """Simulate a recording: lidar scans, an IMU and exact poses.

    Road drives are written as KITTI raw data, recordings of other platforms as plain folders with 200 Hz IMU and point
    times.

    The same options give the same files to the last byte. The same command resumes an interrupted simulation.
    """
    from hybridlio.simulation.choices import Scene

    common = {
        "seconds": seconds, "seed": seed, "scene": scene, "lidar": lidar, "start_moving": not start_at_rest,
        "drive_seed": drive_seed,
    }  # fmt: skip
    road = {
        "length_m": length_m, "speed_m_s": speed, "driving": driving, "gps": gps, "loops": loops, "poses": poses,
        "poses_frame": poses_frame, "motion_distortion": distortion,
        "rain_mm_h": rain, "dust_per_km": dust,
    }  # fmt: skip
    body = {"platform": platform, "imu": imu, "people": people}
    is_road = scene in get_args(Scene)
    config, write = _road_drive(common | road, body) if is_road else _platform(common | body, road)
    _write(out, config, write)


def _road_drive(values: dict[str, Any], others: dict[str, Any]) -> tuple[Any, Any]:
    """Return the settings of a road drive, and what writes it."""
    from hybridlio.simulation import SimulationConfig
    from hybridlio.simulation import simulate as write_drive

    if given := [name for name, value in others.items() if value is not None]:
        raise ConfigError(f"--{given[0]} is for the scenes of other platforms, not for the road {values['scene']!r}")
    return _validated(SimulationConfig, {k: v for k, v in values.items() if v is not None or k != "lidar"}), write_drive


def _platform(values: dict[str, Any], others: dict[str, Any]) -> tuple[Any, Any]:
    """Return the settings of a platform's recording, and what writes it."""
    from hybridlio.simulation.choices import Scene
    from hybridlio.simulation.config import SimulationConfig
    from hybridlio.simulation.platforms.config import PlatformConfig
    from hybridlio.simulation.platforms.scenes.table import SCENES
    from hybridlio.simulation.platforms.simulate import simulate_platform

    if values["scene"] not in SCENES:
        scenes = ", ".join((*get_args(Scene), *SCENES))
        raise ConfigError(f"--scene: unknown scene {values['scene']!r}; choose one of {scenes}")
    usual = SimulationConfig()
    for name, value in others.items():
        if name != "motion_distortion" and value != getattr(usual, name):  # such recordings are always distorted
            raise ConfigError(
                f"{_option(name)} is for roads ({', '.join(get_args(Scene))}), not for {values['scene']!r}"
            )
    return _validated(PlatformConfig, {k: v for k, v in values.items() if v is not None}), simulate_platform


def _validated(kind: Any, values: dict[str, Any]) -> Any:
    from pydantic import ValidationError

    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError("; ".join(_describe(e["loc"], e["msg"]) for e in error.errors())) from None


def _write(out: Path, config: Any, write: Any) -> None:
    from hybridlio.datasets.protection import check_output
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.runs.own_files import RUN
    from hybridlio.runs.whole_folder import held

    place = out.expanduser().resolve()
    if run := next((above for above in (place, *place.parents) if RUN.are_in(above)), None):
        raise ConfigError(f"{out} is or lies inside the run folder {run}; choose another folder")
    check_output(out, may_hold=True)
    try:
        with held(place / f"drive-{config.seed:04d}"), progress("simulating") as report:
            folder = write(out, config, report)
    except KeyboardInterrupt:
        print_message("interrupted; the same command resumes the simulation")
        raise typer.Exit(INTERRUPTED) from None
    sequence = open_sequence(folder)
    length = f", {sequence.reference.length_m:.1f} m" if sequence.reference is not None else ""
    print_result(f"{sequence.name}: {len(sequence)} scans{length} in {sequence.duration_s:.1f} s")
    print_result(f"{folder}")


def _describe(place: tuple[int | str, ...], message: str) -> str:
    return f"{_option(str(place[0]) if place else 'options')}: {message.removeprefix('Value error, ')}"


def _option(name: str) -> str:
    return "--" + {"speed_m_s": "speed", "rain_mm_h": "rain", "dust_per_km": "dust"}.get(name, name).replace("_", "-")
