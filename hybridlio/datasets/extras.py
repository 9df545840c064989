"""What a recording may hold beside KITTI's files: GPS fixes, and what a simulation says about itself."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.errors import DataError
from hybridlio.sensors import LIDAR_MODELS, GpsFix, ImuNoise, LidarModel

GPS_COLUMNS = ("stamp_ns", "east", "north", "up", "sigma")
_LEAST_SIGMA_M = 1e-3  # an exact fix still needs a covariance that can be inverted


@dataclass(frozen=True)
class Simulation:
    """The sensors that a simulated recording says it was made with."""

    lidar: LidarModel
    imu_noise: ImuNoise | None


def read_gps_csv(path: Path) -> tuple[GpsFix, ...]:
    """Fixes of a CSV file with the columns ``stamp_ns,east,north,up,sigma`` (metres); none where there is no file.

    Raises:
        DataError: a column is missing or a row is malformed; names file and line.
    """
    if not path.is_file():
        return ()
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        missing = set(GPS_COLUMNS) - set(rows.fieldnames or ())
        if missing:
            raise DataError(f"{path}: the header lacks {', '.join(sorted(missing))}; expected {','.join(GPS_COLUMNS)}")
        return tuple(sorted((_fix(path, rows.line_num, row) for row in rows), key=lambda fix: fix.stamp_ns))


def _fix(path: Path, line: int, row: dict[str, str]) -> GpsFix:
    try:
        stamp, position = int(row["stamp_ns"]), np.array([row["east"], row["north"], row["up"]], dtype=np.float64)
        sigma = float(row["sigma"])
    except (ValueError, TypeError):
        raise DataError(f"{path}, line {line}: expected numbers in {','.join(GPS_COLUMNS)}") from None
    if not np.isfinite(position).all() or not 0 <= sigma < np.inf:
        raise DataError(f"{path}, line {line}: position must be finite and sigma not negative")
    return GpsFix(stamp, position, max(sigma, _LEAST_SIGMA_M) ** 2 * np.eye(3))


def read_simulation(path: Path) -> Simulation | None:
    """The sensors of ``simulation.json``; None where there is no file.

    Raises:
        DataError: not JSON, or the lidar's name is unknown.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({error})") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected an object with 'lidar' and 'imu_noise'")
    return Simulation(_lidar(path, content), _imu_noise(content.get("imu_noise")))


def _lidar(path: Path, content: dict[str, Any]) -> LidarModel:
    name = content.get("lidar")
    if name not in LIDAR_MODELS:
        raise DataError(f"{path}: unknown lidar {name!r}; known: {', '.join(LIDAR_MODELS)}")
    return LIDAR_MODELS[name]


def _imu_noise(values: dict[str, float] | None) -> ImuNoise | None:
    if not values:
        return None
    return ImuNoise(**{f.name: float(values[f.name]) for f in fields(ImuNoise) if f.name in values})
