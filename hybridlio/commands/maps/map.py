"""``hybridlio map``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_result, print_warning, progress
from hybridlio.core.errors import ConfigError
from hybridlio.core.tables import counted

if TYPE_CHECKING:
    from hybridlio.core.progress import Progress
    from hybridlio.mapping.build import MapTiles
    from hybridlio.runs.results.map_source import MapSource


Run = Annotated[
    Path,
    typer.Argument(metavar="RUN", help="A run folder; the smoothed poses are used if it has them.", show_default=False),
]
Out = Annotated[
    Path,
    typer.Option(
        "-o",
        "--out",
        metavar="FILE",
        help="The map: .ply, .pcd, .las, .laz or .npz; with --tiles a folder.",
        show_default=False,
    ),
]
Data = Annotated[
    Path | None, typer.Option("--data", metavar="DATA", help="The recording, if it is not where the run found it.")
]
Poses = Annotated[
    Path | None,
    typer.Option("--poses", metavar="FILE", help="Lidar poses (TUM or KITTI format) to use instead of the run's."),
]
Voxel = Annotated[float, typer.Option("--voxel", metavar="M", help="Distance between the map's points.")]
MinRange = Annotated[float, typer.Option("--min-range", metavar="M", help="Leave out points nearer to the lidar.")]
MaxRange = Annotated[float, typer.Option("--max-range", metavar="M", help="Leave out points farther from the lidar.")]
Colour = Annotated[
    str,
    typer.Option(
        "--color", "--colour", metavar="NAME", autocompletion=completion.colour, help="height, intensity, time or none."
    ),
]
KeepMoving = Annotated[
    bool, typer.Option("--keep-moving", help="Keep the points of moving objects, which are removed by default.")
]
Normals = Annotated[bool, typer.Option("--normals/--no-normals", help="Estimate a normal for each point.")]
Tiles = Annotated[
    str | None,
    typer.Option(
        "--tiles",
        metavar="FORMAT",
        autocompletion=completion.map_format,
        help="Write a folder of tiles of 50 m, such as `--tiles laz`, for large areas.",
    ),
]
Mesh = Annotated[bool, typer.Option("--mesh", help="Write a triangle mesh; for small areas.")]
Georeference = Annotated[
    bool,
    typer.Option("--georeference", help="Align the map with the run's GPS fixes: east-north-up; .las and .laz in UTM."),
]


@guarded
def map_(
    run: Run,
    out: Out,
    data: Data = None,
    poses: Poses = None,
    voxel: Voxel = 0.1,
    min_range: MinRange = 1.5,
    max_range: MaxRange = 100.0,
    frames: common.Frames = None,
    colour: Colour = "height",
    keep_moving: KeepMoving = False,
    normals: Normals = True,
    tiles: Tiles = None,
    mesh: Mesh = False,
    overwrite: common.Overwrite = False,
    georeference: Georeference = False,
    _verbosity: common.Verbose = 0,
) -> None:
    """Write the map of a run: its scans as one coloured cloud, without moving objects."""
    from hybridlio.mapping.build import map_tiles
    from hybridlio.mapping.settings import MapSettings
    from hybridlio.runs.results.map_source import open_map_source
    from hybridlio.runs.whole_folder import held

    settings = MapSettings(voxel, min_range, max_range, remove_moving=not keep_moving, normals=normals or mesh)
    output = _Output(out, colour, None if tiles is None else f".{tiles.lstrip('.')}", mesh, overwrite)
    output.check(data or run)
    source = open_map_source(run, data, poses)
    if georeference:
        source = source.georeferenced()
    part = source.part(frames)
    with (
        held(out.expanduser()),  # no second writer
        progress("map", units={"tiles": "tiles"}) as report,
        map_tiles(part.sequence, part.trajectory, settings, skip=part.skip, progress=report) as built,
    ):
        made = output.write(built, voxel, source, report)
    print_result(f"{source.name}: {counted(built.scans, 'scan')} by the poses of {source.poses_from}, {made}")
    if built.left_out:
        print_warning(f"{counted(built.left_out, 'scan')} left out: without a pose, bridged or unreadable")
    if georeference and source.origin is None:
        print_warning("the fixes have no geodetic origin; the map is east-north-up, without a place on Earth")
    print_result(f"map     {out}")


@dataclass(frozen=True)
class _Output:
    """Where the map goes, and in which form."""

    path: Path
    colour: str
    tile_suffix: str | None
    mesh: bool
    overwrite: bool

    def check(self, recording: Path) -> None:
        """Check all that can be wrong with the output before the work begins."""
        from hybridlio.datasets.protection import check_new_file, check_output
        from hybridlio.mapping.colours import check_colour
        from hybridlio.mapping.files import check_map_path
        from hybridlio.mapping.mesh import check_mesh_path

        check_colour(self.colour)
        if self.mesh and self.tile_suffix is not None:
            raise ConfigError("--mesh and --tiles exclude each other: a mesh is one file")
        if self.mesh:
            check_mesh_path(self.path)
        else:
            check_map_path(self.path if self.tile_suffix is None else self.path / f"tile{self.tile_suffix}")
        if self.tile_suffix is None:
            check_new_file(self.path, self.overwrite, recording)
        else:
            check_output(self.path, recording, may_hold=True)

    def write(self, tiles: MapTiles, voxel_m: float, source: MapSource, report: Progress) -> str:
        """Write the map; return what it consists of."""
        from hybridlio.mapping.files import holds_crs, write_map
        from hybridlio.mapping.map_projection import crs_of, projected, utm_crs
        from hybridlio.mapping.mesh import write_mesh
        from hybridlio.mapping.point_map import PointMap
        from hybridlio.mapping.tile_folder import write_tiles

        keeps_crs = holds_crs(self.tile_suffix or self.path.suffix)
        place, stated = (source.origin, source.crs) if keeps_crs else (None, None)
        crs = utm_crs(place) if place is not None else None if stated is None else crs_of(stated)
        if self.tile_suffix is not None:
            project = None if place is None else partial(projected, origin=place)
            count = write_tiles(self.path, tiles, self.tile_suffix, self.colour, project, crs, report)
            return f"{counted(count, 'point')} in {counted(len(tiles.names), 'tile')}"
        parts = []
        for tile in tiles.names:
            parts.append(tiles.points(tile))
            report("tiles", len(parts), len(tiles.names))
        points = PointMap.joined(parts)
        if self.mesh:
            return counted(write_mesh(self.path, points, voxel_m, self.colour), "triangle")
        write_map(self.path, points if place is None else projected(points, place), self.colour, crs)
        return counted(len(points), "point")
