"""A folder of map tiles, for areas too large for one file."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core.errors import ConfigError
from hybridlio.core.files import make_folder, write_atomically
from hybridlio.core.progress import Progress
from hybridlio.mapping.build import MapTiles
from hybridlio.mapping.files import write_map
from hybridlio.mapping.point_map import PointMap

if TYPE_CHECKING:
    from pyproj import CRS

INDEX, _WRITING = "tiles.json", ".tiles.json"
_TILE = re.compile(r"x[+-]\d{4,}_y[+-]\d{4,}\.\w+")  # a name of ours


def write_tiles(
    folder: Path,
    tiles: MapTiles,
    suffix: str,
    colour: str = "height",
    project: Callable[[PointMap], PointMap] | None = None,
    crs: CRS | None = None,
    progress: Progress | None = None,
) -> int:
    """Write each tile of a map to a file, and then ``tiles.json``, which lists them with their extents.

    Tiles of an earlier map in the folder that this one does not have are removed at the end.

    Args:
        folder: made if missing.
        tiles: the map.
        suffix: format of the files, of :data:`hybridlio.mapping.files.FORMATS`.
        colour: as in :func:`~hybridlio.mapping.files.write_map`; its range is that of each tile.
        project: applied to each tile's points, such as a projection to UTM.
        crs: of the projected points.
        progress: called after each tile.

    Returns:
        The number of points.

    Raises:
        ConfigError, DataError: as :func:`~hybridlio.mapping.files.write_map`; or there is a file of a tile's name that
            no earlier map has written.
    """
    make_folder(folder)
    old, rows, total = _files_of(folder), [], 0
    file_names = {tile: f"x{tile[0]:+05d}_y{tile[1]:+05d}{suffix}" for tile in tiles.names}
    _claim(folder, list(file_names.values()), old)
    for done, (tile, name) in enumerate(file_names.items(), 1):
        points = tiles.points(tile)
        if len(points):
            points = points if project is None else project(points)
            write_map(folder / name, points, colour, crs)
            extent = [np.round(end(points.points, axis=0), 3).tolist() for end in (np.min, np.max)]
            rows.append({"file": name, "points": len(points), "min": extent[0], "max": extent[1]})
            total += len(points)
        if progress is not None:
            progress("tiles", done, len(tiles.names))
    index = {"tile_m": tiles.tile_m, "crs": None if crs is None else crs.to_string(), "tiles": rows}
    write_atomically(folder / INDEX, json.dumps(index, indent=2) + "\n")
    for name in old - {str(row["file"]) for row in rows}:
        (folder / name).unlink(missing_ok=True)
    (folder / _WRITING).unlink()
    return total


def _claim(folder: Path, names: list[str], old: set[str]) -> None:
    """Note in a hidden file which tiles are written, so that a map knows those of a run that was killed.

    Raises:
        ConfigError: one of them is there, and no tile of an earlier map.
    """
    if taken := [name for name in names if name not in old and (folder / name).exists()]:
        raise ConfigError(f"{folder / taken[0]} is no tile of an earlier map; choose another folder")
    write_atomically(folder / _WRITING, json.dumps({"tiles": [{"file": name} for name in {*names, *old}]}) + "\n")


def _files_of(folder: Path) -> set[str]:
    """Return the tiles that earlier maps wrote to a folder, finished or not; of its names no others."""
    return _listed(folder / INDEX) | _listed(folder / _WRITING)


def _listed(index: Path) -> set[str]:
    try:
        tiles = json.loads(index.read_text(encoding="utf-8"))["tiles"]
        return {name for name in (str(tile["file"]) for tile in tiles) if _TILE.fullmatch(name)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()
