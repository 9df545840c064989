"""What a recording may hold beside KITTI's files: GPS fixes, and what a simulation says about itself."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, check_geodetic, enu_from_geodetic, origin_of
from hybridlio.core.sensors import LIDAR_MODELS, NS_PER_S, GpsFix, ImuNoise, LidarModel
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.sequence import Notes

_LOCAL, _GEODETIC = ("east", "north", "up"), ("latitude", "longitude", "height")
_LEAST_SIGMA_M = 1e-3  # an exact fix still needs a covariance that can be inverted


@dataclass(frozen=True)
class Simulation:
    """The sensors that a simulated recording says it was made with."""

    lidar: LidarModel
    imu_noise: ImuNoise | None


def read_gps_csv(path: Path) -> tuple[GpsFix, ...]:
    """Fixes of a CSV file, in order of time; none where there is no file.

    The columns are ``stamp_ns``, ``sigma`` (metres) and where the antenna was: ``east``, ``north``, ``up`` in metres in
    a frame of the file's own, or ``latitude``, ``longitude``, ``height`` in degrees and metres (WGS 84), whose frame is
    that at the first row. With both, the frame is the file's own, and where it lies on Earth is known.

    Raises:
        DataError: a column is missing, or a row is malformed or no place on Earth; names file and line.
    """
    if not path.is_file():
        return ()
    header, rows = read_csv(path)
    local, geodetic = set(header) >= set(_LOCAL), set(header) >= set(_GEODETIC)
    if not set(header) >= {"stamp_ns", "sigma"} or not (local or geodetic):
        missing = {"stamp_ns", "sigma", *_LOCAL} - set(header)
        raise DataError(
            f"{path}: the header lacks {', '.join(sorted(missing))}; expected stamp_ns, sigma and "
            f"{','.join(_LOCAL)} or {','.join(_GEODETIC)}"
        )
    names = ("stamp_ns", "sigma") + (_LOCAL if local else ()) + (_GEODETIC if geodetic else ())
    read = [_numbers(path, line, dict(zip(header, row, strict=True)), names) for line, row in rows]
    if not read:
        return ()
    first = GeodeticPoint(*read[0][-3:]) if geodetic else None
    origin = origin_of(read[0][2:5], first) if first is not None and local else first
    return tuple(sorted((_fix(numbers, local, origin) for numbers in read), key=lambda fix: fix.stamp_ns))


def _numbers(path: Path, line: int, row: dict[str, str], names: tuple[str, ...]) -> list[float]:
    """The row's numbers, the stamp first and exact."""
    try:
        numbers = [int(row["stamp_ns"]), *(float(row[name]) for name in names[1:])]
    except (ValueError, TypeError):
        raise DataError(f"{path}, line {line}: expected numbers in {','.join(names)}") from None
    if not np.isfinite(numbers[1:]).all() or numbers[1] < 0:
        raise DataError(f"{path}, line {line}: position must be finite and sigma not negative")
    if names[-len(_GEODETIC) :] == _GEODETIC:
        latitude, longitude, height = numbers[-len(_GEODETIC) :]
        check_geodetic(latitude, longitude, height, f"{path}, line {line}")
    return numbers


def note_fixes(fixes: tuple[GpsFix, ...], scans_ns: NDArray[np.int64], notes: Notes) -> None:
    """Say if no fix lies within the time of the scans, as with another clock."""
    if fixes and not any(scans_ns[0] <= fix.stamp_ns <= scans_ns[-1] for fix in fixes):
        away = (fixes[0].stamp_ns - int(scans_ns[0])) / NS_PER_S
        notes.add(f"no GPS fix lies within the scans' time: they begin {away:+.1f} s from the first scan")


def _fix(numbers: list[float], local: bool, origin: GeodeticPoint | None) -> GpsFix:
    stamp, sigma = int(numbers[0]), max(numbers[1], _LEAST_SIGMA_M)
    given = np.array(numbers[2:5])
    position = given if local or origin is None else enu_from_geodetic([given], origin)[0]
    return GpsFix(stamp, position, sigma**2 * np.eye(3), origin)


def read_simulation(path: Path) -> Simulation | None:
    """The sensors of ``simulation.json``; None where there is no file.

    Raises:
        DataError: not JSON, the lidar's name is unknown, or the IMU's noise is not of numbers that it can be.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({error})") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected an object with 'lidar' and 'imu_noise'")
    return Simulation(_lidar(path, content), _imu_noise(path, content.get("imu_noise")))


def _lidar(path: Path, content: dict[str, Any]) -> LidarModel:
    name = content.get("lidar")
    if name not in LIDAR_MODELS:
        raise DataError(f"{path}: unknown lidar {name!r}; known: {', '.join(LIDAR_MODELS)}")
    return LIDAR_MODELS[name]


def _imu_noise(path: Path, values: Any) -> ImuNoise | None:
    if not values:
        return None
    if not isinstance(values, dict):
        raise DataError(f"{path}: imu_noise: expected an object of numbers")
    try:
        return ImuNoise(**{f.name: float(values[f.name]) for f in fields(ImuNoise) if f.name in values})
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: imu_noise: {error}") from None
