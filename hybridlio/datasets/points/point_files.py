"""Scan files of every kind, and the loader of a recording's scans.

Columns are found by name if the format has names: ``x y z`` in the lidar frame (x forward, y left, z up), an intensity,
a time (:mod:`hybridlio.datasets.points.point_times`). Those of ``.bin`` files are found from their values
(:mod:`hybridlio.datasets.points.bin_layout`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points import mesh_vertices, pcd, ply, tables, text_rows
from hybridlio.datasets.points.bin_layout import BinLayout, column_names, find_layout
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_format import PointFormat, StatedFormat, learn_format, sampled

SUFFIXES = (".bin", ".npy", ".pcd", ".ply", ".las", ".laz", ".feather", ".parquet", *text_rows.SUFFIXES)

_CLOUD_COMPARE = "scalar_"  # before the names of fields in its .ply files

_READERS: dict[str, Callable[[Path], Columns]] = {
    ".pcd": pcd.read_pcd,
    ".ply": ply.read_ply,
    ".las": tables.read_las,
    ".laz": tables.read_las,
    ".feather": tables.read_arrow,
    ".parquet": tables.read_arrow,
    **dict.fromkeys(mesh_vertices.SUFFIXES, mesh_vertices.read_vertices),
}


@dataclass(frozen=True)
class PointFiles:
    """Loads scan ``k`` from ``paths[k]`` with stamp ``stamps_ns[k]``. An object, so that it can be pickled.

    Attributes:
        paths: one file per scan.
        stamps_ns: one stamp per scan.
        read: reads the columns of a file.
        format: how the columns are read.
    """

    paths: tuple[Path, ...]
    stamps_ns: Stamps
    read: Callable[[Path], Columns]
    format: PointFormat

    def columns(self, k: int) -> Columns:
        """Return the columns of scan ``k``, as the file holds them.

        Raises:
            DataError: the file cannot be read; the message does not name it.
        """
        return self.read(self.paths[k])

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``.

        Raises:
            DataError: the file is missing, truncated, or without a usable point; the message names frame and file.
        """
        path = self.paths[k]
        try:
            return self.format.scan(self.read(path), int(self.stamps_ns[k]))
        except DataError as error:
            raise DataError(f"frame {k}: {_at(path, error)}") from None


def open_point_files(
    paths: tuple[Path, ...],
    stamps_ns: Stamps,
    notes: Notes,
    layout: BinLayout | None = None,
    stated: StatedFormat | None = None,
    read: Callable[[Path], Columns] | None = None,
) -> PointFiles:
    """Look at some scans of a recording, and return the loader of all.

    Args:
        paths: one file per scan, all of one kind.
        stamps_ns: ``(N,)`` int64.
        notes: receives what was found.
        layout: the columns of ``.bin`` files; found by default.
        stated: what the user states about the points.
        read: reads the columns of a file, for formats of a data set's own; must be picklable.

    Raises:
        DataError: the columns or their meaning cannot be found. A scan that cannot be read is passed over here; its
            error comes when it is loaded.
    """
    step_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else None
    if read is None:
        if layout is None and paths[0].suffix.lower() == ".bin":
            layout = find_layout([paths[k] for k in sampled(len(paths))], step_ns, notes)
        read = partial(read_columns, layout=layout, step_ns=step_ns)
    reader = read

    def columns_of(k: int) -> Columns:
        try:
            return reader(paths[k])
        except DataError as error:
            raise DataError(_at(paths[k], error)) from None

    try:
        found = learn_format(stamps_ns, columns_of, notes, stated)
    except DataError as error:
        named = str(error).startswith(str(paths[0].parent))
        raise DataError(str(error) if named else _at(paths[0].parent if len(paths) > 1 else paths[0], error)) from None
    if paths[0].suffix.lower() == ".pcd":
        pcd.note_viewpoints([paths[k] for k in sampled(len(paths))], notes)
    return PointFiles(paths, stamps_ns, read, found)


def read_columns(path: Path, layout: BinLayout | None = None, step_ns: int | None = None) -> Columns:
    """Read the columns of a scan file, by lower-case name.

    Args:
        path: the file.
        layout: the columns of a ``.bin`` file; KITTI's by default.
        step_ns: median distance between the stamps, to recognise times in files without names.

    Raises:
        DataError: the file is missing, malformed or truncated; the message does not name it.
    """
    if not path.is_file():
        raise DataError("no such file")
    suffix = path.suffix.lower()  # file systems of memory cards write capitals
    if suffix == ".bin":
        return (layout or BinLayout()).read(path)
    if suffix in _READERS:
        return {name.lower().removeprefix(_CLOUD_COMPARE): v for name, v in _READERS[suffix](path).items()}
    values = tables.read_npy(path) if suffix == ".npy" else text_rows.read_text(path)
    if isinstance(values, dict):
        return {name.lower(): column for name, column in values.items()}
    names = ["x", "y", "z", *column_names(values[:, 3:], step_ns)]
    return {name: values[:, k] for k, name in enumerate(names) if not name.startswith("_")}


def read_scan(path: Path, stamp_ns: int) -> Scan:
    """Read one scan file by itself, finding its columns and times from its own values.

    Raises:
        DataError: the file cannot be read or its columns have no clear meaning; the message names the file.
    """
    notes = Notes(path.name)
    loader = open_point_files((path,), np.array([stamp_ns], np.int64), notes)
    try:
        return loader.format.scan(loader.read(path), stamp_ns)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _at(path: Path, error: DataError) -> str:
    return f"{path}: {error}"
