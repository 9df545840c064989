"""The columns of headerless ``.bin`` scans: stated by the user, or found from sizes and values of several scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.fields import Columns

_COUNTS = range(3, 8)  # x y z alone, up to x y z with intensity, ring, time and one more: what data sets publish
_TYPES = ("<f8", "<f4")
_NAMES = {"<f4": "float32", "<f8": "float64"}
_VALUES_READ = 105_000  # of each scan: enough to tell columns apart, and a multiple of every number of columns
_MAX_COORDINATE_M = 1000.0  # several times the range of a lidar on a vehicle
_TINY = 1e-6  # below a micrometre: no coordinate, but usual where bytes are read as another type
_MAX_STRANGE = 0.005  # share of the values
_MIN_FINITE = 0.1  # share of the points; organised clouds hold NaN where nothing returned
_MAX_SIGNED_SPAN = 1.2  # of a column with negative values: times around the stamp in seconds, or shares of a sweep
_BINS = 16  # of the values, for the information that a column's number gives on them
_CLEAR = 10.0  # nats between best and second best; "very strong" (Kass and Raftery, "Bayes factors", JASA 1995)
_RINGS = 256  # at most: no lidar has more beams
_SWEEP_SHARE = (0.8, 1.05)  # of the distance between stamps, which a column of times spans
_MIN_SECONDS_SHARE = 0.2  # the same for seconds, of which a part of the sweep is enough: other columns are larger
_STEP_S = 0.1  # between stamps where a single scan leaves it unknown
_UNITS = (1.0, 1e3, 1e6, 1e9)  # of a second
_HOW = (
    "state the columns in calibration.yaml, such as 'columns: [x, y, z, intensity, ring, time]', or with types "
    "'columns: {x: float64, y: float64, z: float64, _1: uint8}'; names that start with _ are not used"
)


@dataclass(frozen=True)
class BinLayout:
    """The columns of a ``.bin`` scan.

    Attributes:
        fields: name and NumPy type of each column; names that start with ``_`` are not used.
    """

    fields: tuple[tuple[str, str], ...] = (("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"))

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of one point."""
        return np.dtype(list(self.fields))

    def read(self, path: Path) -> Columns:
        """Read the columns of a scan.

        Raises:
            DataError: the file cannot be read, is empty, or its size is no multiple of a point's.
        """
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot read the scan ({error.strerror})") from None
        if not data:
            raise DataError("the scan has no points (0 bytes)")
        if len(data) % self.dtype.itemsize:
            raise DataError(
                f"truncated scan, {len(data)} bytes is no multiple of {self.dtype.itemsize} ({len(self.fields)} columns"
                " a point)"
            )
        rows = np.frombuffer(data, self.dtype)
        return {name: rows[name] for name, _ in self.fields if not name.startswith("_")}


def stated_layout(columns: Any) -> BinLayout:
    """Return the layout that a user states: a list of names of float32 columns, or a mapping of names to types.

    Raises:
        DataError: it is neither, a type is unknown, a name repeats, or x, y or z is missing.
    """
    pairs = dict(columns) if isinstance(columns, dict) else {}
    if isinstance(columns, list):
        names = [f"_{k}" if name in ("_", None) else str(name) for k, name in enumerate(columns)]
        pairs = dict.fromkeys(names, "float32")
        if len(pairs) != len(columns):
            raise DataError(f"columns: a name repeats in {columns}; {_HOW}")
    try:
        fields = tuple((str(name), np.dtype(str(kind))) for name, kind in pairs.items())
    except TypeError:
        raise DataError(f"columns: unknown type in {pairs}; use NumPy's names such as float32 or uint16") from None
    if not {"x", "y", "z"} <= {name for name, _ in fields} or any(kind.kind not in "iuf" for _, kind in fields):
        raise DataError(f"columns: need x, y and z, of types of numbers, got {columns!r}; {_HOW}")
    return BinLayout(tuple((name, kind.str) for name, kind in fields))


def find_layout(paths: Sequence[Path], step_ns: int | None, notes: Notes) -> BinLayout:
    """Find type, number and names of the columns from some of a recording's scans, and note them.

    A number of columns fits if it divides the sizes of most files and gives plausible coordinates. Of those that fit,
    the one is taken that separates the values best: with the right number, each column holds one kind of value, and the
    mutual information between a value and its column is largest (less the Bayesian information criterion's penalty).

    Args:
        paths: the scans to look at.
        step_ns: median distance between the stamps; None if there is one scan.
        notes: receives the result.

    Raises:
        DataError: nothing fits, or two layouts fit about equally well.
    """
    scans = {path: path.stat().st_size for path in paths if path.is_file()}
    scores: list[tuple[float, str, int]] = []
    for kind in _TYPES:
        tables = {path: np.fromfile(path, kind, count=_VALUES_READ) for path in scans}
        for count in _COUNTS:
            width = count * np.dtype(kind).itemsize
            fitting = [path for path, size in scans.items() if size and size % width == 0]
            rows = [tables[path][: len(tables[path]) // count * count].reshape(-1, count) for path in fitting]
            if 2 * len(fitting) > len(scans) and all(_is_plausible(table) for table in rows):
                scores.append((sum(_evidence(table) for table in rows), kind, count))
        if scores:  # float32 values read as float64 are never plausible, the reverse can be
            break
    scores.sort(reverse=True)
    if not scores or (len(scores) > 1 and scores[0][0] < scores[1][0] + _CLEAR):
        options = " or ".join(f"{count} columns of {_NAMES[kind]}" for _, kind, count in scores)
        where = f"{paths[0].parent}: " if paths else ""
        raise DataError(f"{where}the .bin scans can hold {options or 'no x y z that makes sense'}; {_HOW}")
    _, kind, count = scores[0]
    width = count * np.dtype(kind).itemsize
    whole = [path for path, size in scans.items() if size and size % width == 0]
    values = np.concatenate([np.fromfile(p, kind).reshape(-1, count)[:, 3:] for p in whole])
    names = ["x", "y", "z", *column_names(values, step_ns)]
    notes.found(
        f".bin scans: {count} columns of {_NAMES[kind]}, {' '.join(_shown(name) for name in names)}, found from sizes "
        "and values; 'columns:' in calibration.yaml overrides"
    )
    return BinLayout(tuple((name, kind) for name in names))


def column_names(values: NDArray[Any], step_ns: int | None) -> list[str]:
    """Return names of the columns ``(N, C)`` behind x y z, by their values; those that are not clear start with ``_``.

    The first is the intensity, as in all layouts that we know (KITTI, nuScenes). Of the others, whole numbers below 256
    are the ring, and a column that spans the time between scans is the time.
    """
    names: list[str] = []
    step_s = _STEP_S if step_ns is None else step_ns / 1e9
    for k, column in enumerate(values.T):
        known = column[np.isfinite(column)]
        if not k:
            names.append("intensity")
        elif "ring" not in names and len(known) and _is_ring(known):
            names.append("ring")
        elif "time" not in names and len(known) and _is_time(known, step_s):
            names.append("time")
        else:
            names.append(f"_{k + 4}")
    return names


def _shown(name: str) -> str:
    return f"(column {name[1:]} is not used)" if name.startswith("_") else name


def _is_ring(values: NDArray[Any]) -> bool:
    return bool(values.min() >= 0 and values.max() < _RINGS and (values == np.floor(values)).all() and np.ptp(values))


def _is_time(values: NDArray[Any], step_s: float) -> bool:
    span = float(np.ptp(values))
    low, high = _SWEEP_SHARE
    shares = values.min() >= 0 and values.max() <= 1 and span >= low
    seconds = np.abs(values).max() <= high * step_s and span >= _MIN_SECONDS_SHARE * step_s
    return bool(shares or seconds) or any(low * step_s <= span / unit <= high * step_s for unit in _UNITS)


def _is_plausible(rows: NDArray[Any]) -> bool:
    """Return whether rows ``(N, C)`` can be points: coordinates in metres, then columns that are hardly negative."""
    with np.errstate(all="ignore"):
        finite = np.isfinite(rows[:, :3]).all(axis=1)
        if not len(rows) or finite.mean() < _MIN_FINITE:
            return False
        xyz, rest = np.abs(rows[finite, :3]), rows[finite, 3:]
        strange = (xyz > _MAX_COORDINATE_M) | ((xyz < _TINY) & (xyz > 0))
        if strange.mean() > _MAX_STRANGE or not (np.ptp(xyz, axis=0)[:2] > 0).all():
            return False
        if not np.isfinite(rest).all() or ((np.abs(rest) < np.finfo(np.float32).tiny) & (rest != 0)).any():
            return False
        low, high = rest.min(axis=0), rest.max(axis=0)
        return bool(((low >= 0) | ((high - low <= _MAX_SIGNED_SPAN) & (high <= _MAX_SIGNED_SPAN))).all())


def _evidence(rows: NDArray[Any]) -> float:
    """Return how much the columns of ``(N, C)`` tell of the values, in nats, less the penalty of their number."""
    values = np.nan_to_num(rows.ravel(), posinf=0.0, neginf=0.0)
    edges = np.unique(np.quantile(values, np.arange(1, _BINS) / _BINS))
    bins = np.searchsorted(edges, values, side="right")
    width, columns = len(edges) + 1, rows.shape[1]
    table = np.bincount(np.tile(np.arange(columns), len(rows)) * width + bins, minlength=width * columns)
    counts = table.reshape(columns, width).astype(np.float64)
    expected = counts.sum(axis=1, keepdims=True) * counts.sum(axis=0, keepdims=True) / counts.sum()
    information = float((counts[counts > 0] * np.log(counts[counts > 0] / expected[counts > 0])).sum())
    return information - float(0.5 * (columns - 1) * (width - 1) * math.log(len(values)))
