"""Prepared scans on disk: a folder of plain arrays for each recording, read by memory mapping. NumPy only.

A shard is prepared once and read in any order by any number of processes. Coordinates are multiples of 4 mm (int16,
±131 m), normals of 1/127 (int8): far below a lidar's noise, and 0.35 MB a scan. Data of the step to a scan (IMU rows,
reference) are in the scan's row; row 0 has none.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
import uuid
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import write_atomically
from hybridlio.learned.setting_values import from_dict

FORMAT = 1  # raise by 1 when the files of a shard change
_STEP_M = 0.004  # a fifth of an HDL-64E's range noise; int16 then reaches 131 m, beyond the range limit of 120 m
_LIMIT_M = 32767 * _STEP_M  # largest int16
_LARGEST = 1e6  # of any value of a step in SI units; sensors and steps stay thousands of times below it
_STEPS = ("imu", "imu_there", "dt_s", "velocity_m_s", "initial", "reference", "usable")


@dataclass(frozen=True, eq=False)
class ScanRecord:
    """One scan of a shard, with the step that leads to it.

    Attributes:
        vertex_map: ``(3, H, W)`` metres.
        loss_points, loss_normals: ``(K, 3)``, averaged over voxels; points in metres.
        usable: whether the scan has enough points; pairs with an unusable scan are left out.
        imu: ``(S, 6)`` rows of :func:`hybridlio.learned.data.imu_rows.imu_rows` since the last scan, or None.
        dt_s: seconds since the last scan.
        velocity_m_s: ``(3,)`` at the last scan, in its axes, or None.
        initial: ``(4, 4)`` given initial pose ``T_k_k1``, or None.
        reference: ``(4, 4)`` true ``T_k_k1``, or None.
    """

    vertex_map: NDArray[np.float32]
    loss_points: NDArray[np.float32]
    loss_normals: NDArray[np.float32]
    usable: bool = True
    imu: NDArray[np.float32] | None = None
    dt_s: float = 0.0
    velocity_m_s: NDArray[np.float64] | None = None
    initial: NDArray[np.float64] | None = None
    reference: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class ShardInfo:
    """Description of a shard, in ``shard.json``.

    Attributes:
        name: of the recording.
        scans: number of scans.
        geometry: cells of the maps.
        imu_samples: S, the number of IMU rows of a step.
        made_by: how the scans were prepared, for people who find the folder.
        format: version of the file format.
    """

    name: str
    scans: int
    geometry: MapGeometry
    imu_samples: int
    made_by: str = ""
    format: int = FORMAT


def write_shard(
    folder: str | os.PathLike[str],
    scans: Iterable[ScanRecord],
    name: str,
    geometry: MapGeometry,
    imu_samples: int,
    made_by: str = "",
) -> ShardInfo:
    """Write scans, one by one, as a shard that appears complete; replace an existing one.

    Raises:
        DataError: the folder holds something else than a shard, there are fewer than two scans, or a record's arrays
            have wrong shapes.
    """
    folder = Path(folder)
    if folder.exists() and not (folder / "shard.json").is_file():
        raise DataError(f"{folder} exists and is no shard; choose another folder for prepared recordings")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:12]}")
    temporary.mkdir()
    try:
        count = _write_arrays(temporary, scans, geometry, imu_samples)
        info = ShardInfo(name, count, geometry, imu_samples, made_by)
        write_atomically(temporary / "shard.json", json.dumps(asdict(info), indent=2) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return info


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes left of a shard. No other process may be writing it."""
    for left in folder.parent.glob(f".{glob.escape(folder.name)}.{'[0-9a-f]' * 12}"):
        shutil.rmtree(left, ignore_errors=True)


def _write_arrays(folder: Path, scans: Iterable[ScanRecord], geometry: MapGeometry, imu_samples: int) -> int:
    """Write clouds as they come, since they are large, and the rest at the end; return the number of scans."""
    rows: dict[str, list[Any]] = {name: [] for name in _STEPS}
    sizes = [0]
    with (
        (folder / "vertex_maps.raw").open("wb") as maps,
        (folder / "loss_points.raw").open("wb") as points,
        (folder / "loss_normals.raw").open("wb") as normals,
    ):
        for k, scan in enumerate(scans):
            _check(scan, k, geometry, imu_samples)
            maps.write(_whole_steps(scan.vertex_map).tobytes())
            points.write(_whole_steps(scan.loss_points).tobytes())
            normals.write(np.rint(scan.loss_normals * 127).astype(np.int8).tobytes())
            sizes.append(len(scan.loss_points))
            for column, value in _step_row(scan, imu_samples).items():
                rows[column].append(value)
    if len(sizes) < 3:
        raise DataError(f"{folder.name}: a shard needs two scans or more, got {len(sizes) - 1}")
    np.save(folder / "loss_offsets.npy", np.cumsum(sizes, dtype=np.int64))
    for column, values in rows.items():
        np.save(folder / f"{column}.npy", np.stack(values))
    return len(sizes) - 1


def _whole_steps(metres: NDArray[np.float32]) -> NDArray[np.int16]:
    return np.asarray(np.rint(np.clip(metres, -_LIMIT_M, _LIMIT_M) / _STEP_M), np.int16)


def _step_row(scan: ScanRecord, imu_samples: int) -> dict[str, Any]:
    unknown = np.full((4, 4), np.nan)
    velocity = np.full(3, np.nan) if scan.velocity_m_s is None else scan.velocity_m_s
    return {
        "imu": np.zeros((imu_samples, 6), np.float32) if scan.imu is None else scan.imu.astype(np.float32),
        "imu_there": np.bool_(scan.imu is not None),
        "dt_s": np.float32(scan.dt_s),
        "velocity_m_s": np.asarray(velocity, np.float32),
        "initial": np.asarray(unknown if scan.initial is None else scan.initial, np.float64),
        "reference": np.asarray(unknown if scan.reference is None else scan.reference, np.float64),
        "usable": np.bool_(scan.usable),
    }


def _check(scan: ScanRecord, k: int, geometry: MapGeometry, imu_samples: int) -> None:
    cells = (3, geometry.rows, geometry.columns)
    if scan.vertex_map.shape != cells:
        raise DataError(f"scan {k}: the vertex map has shape {scan.vertex_map.shape}, its geometry {cells}")
    if scan.loss_points.ndim != 2 or scan.loss_points.shape != scan.loss_normals.shape:
        raise DataError(f"scan {k}: {scan.loss_points.shape} points with {scan.loss_normals.shape} normals")
    if scan.imu is not None and scan.imu.shape != (imu_samples, 6):
        raise DataError(f"scan {k}: IMU rows have shape {scan.imu.shape}, expected {(imu_samples, 6)}")


class Shard:
    """A shard open for reading; its large arrays are memory-mapped.

    Raises:
        DataError: there is no shard, its format is another version's, or a file has the wrong size.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.info = _read_info(self.folder)
        n, geometry = self.info.scans, self.info.geometry
        steps = {name: self._array(name, shape) for name, shape in self._row_shapes().items()}
        self.imu, self.imu_there, self.dt_s = steps["imu"], steps["imu_there"], steps["dt_s"]
        self.velocity_m_s, self.usable = steps["velocity_m_s"], steps["usable"]
        self.initial, self.reference = steps["initial"], steps["reference"]
        self._offsets = steps["loss_offsets"]
        if self._offsets[0] != 0 or (np.diff(self._offsets) < 0).any():
            raise DataError(f"{self.folder / 'loss_offsets.npy'}: no increasing numbers; prepare the shard again")
        total = int(self._offsets[-1])
        self._maps = self._raw("vertex_maps", np.int16, (n, 3, geometry.rows, geometry.columns))
        self._points = self._raw("loss_points", np.int16, (total, 3))
        self._normals = self._raw("loss_normals", np.int8, (total, 3))

    def __len__(self) -> int:
        return self.info.scans

    def vertex_map(self, k: int) -> NDArray[np.float32]:
        """Return the vertex map ``(3, H, W)`` of scan ``k`` in metres."""
        return np.asarray(self._maps[k] * np.float32(_STEP_M), np.float32)

    def loss_cloud(self, k: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return points in metres and unit normals (zero without one), ``(K, 3)`` each, of scan ``k``."""
        rows = slice(int(self._offsets[k]), int(self._offsets[k + 1]))
        points = np.asarray(self._points[rows] * np.float32(_STEP_M), np.float32)
        normals = self._normals[rows].astype(np.float32)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return points, np.asarray(normals / np.where(length > 0, length, 1), np.float32)

    def _row_shapes(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Return kind and shape of each array of rows."""
        n = self.info.scans
        return {
            "imu": ("f", (n, self.info.imu_samples, 6)),
            **dict.fromkeys(("imu_there", "usable"), ("b", (n,))),
            "dt_s": ("f", (n,)),
            "velocity_m_s": ("f", (n, 3)),
            **dict.fromkeys(("initial", "reference"), ("f", (n, 4, 4))),
            "loss_offsets": ("i", (n + 1,)),
        }

    def _array(self, name: str, expected: tuple[str, tuple[int, ...]]) -> NDArray[Any]:
        path = self.folder / f"{name}.npy"
        try:
            values = np.array(np.load(path, "r", allow_pickle=False))  # mapped: nothing is allocated that is not there
        except (OSError, ValueError, EOFError, OverflowError, MemoryError, SyntaxError, TokenError) as error:
            raise DataError(f"{path}: cannot be read ({error}); prepare the shard again") from error
        if (values.dtype.kind, values.shape) != expected:
            raise DataError(
                f"{path}: {values.dtype} of shape {values.shape} for {self.info.scans} scans; prepare the shard again"
            )
        if values.dtype.kind == "f" and (np.abs(values[np.isfinite(values)]) > _LARGEST).any():
            raise DataError(f"{path}: a value over {_LARGEST:g}; the file is damaged, prepare the shard again")
        return values

    def _raw(self, name: str, dtype: type[np.generic], shape: tuple[int, ...]) -> NDArray[Any]:
        path = self.folder / f"{name}.raw"
        expected = int(np.prod(shape)) * np.dtype(dtype).itemsize
        size = path.stat().st_size if path.is_file() else -1
        if size != expected:
            found = "is missing" if size < 0 else f"has {size} bytes, expected {expected}"
            raise DataError(f"{path}: {found}; prepare the shard again")
        return np.memmap(path, dtype, "r", shape=shape) if expected else np.empty(shape, dtype)


def _read_info(folder: Path) -> ShardInfo:
    path = folder / "shard.json"
    if not path.is_file():
        raise DataError(f"{folder}: no shard (shard.json is missing); prepare the recording first")
    try:
        values = json.loads(path.read_text())
        if values["format"] != FORMAT:
            raise DataError(f"{path}: format {values['format']}, this version reads {FORMAT}; prepare the shard again")
        return from_dict(ShardInfo, values, "shard")
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ConfigError) as error:
        raise DataError(f"{path}: not the description of a shard ({error}); prepare the shard again") from error
