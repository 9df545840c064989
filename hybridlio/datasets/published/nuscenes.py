"""Reader of nuScenes (Caesar et al., "nuScenes", CVPR 2020; layout by its development kit's schema).

v1.0-*/scene.json  sample.json  sample_data.json  calibrated_sensor.json  ego_pose.json
samples/LIDAR_TOP/*.pcd.bin  sweeps/LIDAR_TOP/*.pcd.bin    float32 x y z intensity ring
can_bus/scene-NNNN_ms_imu.json                             optional: the CAN bus extension, 100 Hz
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.imu_csv import clean_imu
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import US, in_order, poses_of

_LAYOUT = BinLayout(tuple((name, "<f4") for name in ("x", "y", "z", "intensity", "ring")))
_TEXTS = ("token", "name", "filename")  # ends of the names of columns that hold texts
_LARGEST_US = 2**52  # exact in float64, and far from the limit of int64 nanoseconds


def _is_root(path: Path) -> bool:
    return (path / "samples/LIDAR_TOP").is_dir()


def scenes(path: Path) -> dict[str, Path]:
    """Find the scenes of the tables at or below ``path``: ``<tables>/<scene>`` by name, such as ``scene-0061``."""
    if path.name.startswith("scene-") and (path.parent / "scene.json").is_file():
        return {path.name: path}
    folders = [p for p in (path, *sorted(path.glob("v1.0-*"))) if (p / "scene.json").is_file()]
    return {str(row["name"]): p / str(row["name"]) for p in folders for row in _rows(p / "scene.json", "name")}


def _rows(path: Path, *keys: str) -> list[dict[str, Any]]:
    """Return the rows of a table, which have ``keys``."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error})") from None
    if not isinstance(rows, list):
        raise DataError(f"{path}: expected a list of rows")
    for number, row in enumerate(rows):
        if not isinstance(row, dict) or (missing := [key for key in keys if key not in row]):
            what = f"lacks {missing[0]!r}" if isinstance(row, dict) else "is no object"
            raise DataError(f"{path}: row {number} {what}")
        if wrong := [key for key in keys if key.endswith(_TEXTS) and not isinstance(row[key], str)]:
            raise DataError(f"{path}: row {number}: {wrong[0]!r} must be a text")
    return rows


def _gather(scene: Path, notes: Notes) -> Recording:
    tables, root = scene.parent, scene.parent.parent
    tokens = [row["token"] for row in _rows(tables / "scene.json", "name", "token") if row["name"] == scene.name]
    if not tokens:
        raise DataError(f"{tables / 'scene.json'}: no {scene.name}")
    samples = {
        r["token"] for r in _rows(tables / "sample.json", "token", "scene_token") if r["scene_token"] == tokens[0]
    }
    keys = ("filename", "sample_token", "timestamp", "calibrated_sensor_token", "ego_pose_token")
    rows = [
        row
        for row in _rows(tables / "sample_data.json", *keys)
        if row["sample_token"] in samples and "/LIDAR_TOP/" in str(row["filename"])
    ]
    if not rows:
        raise DataError(f"{tables / 'sample_data.json'}: no lidar data of {scene.name}")
    rows.sort(key=lambda row: _time_us(tables / "sample_data.json", row["timestamp"]))
    stamps = np.array([_time_us(tables, row["timestamp"]) * US for row in rows], dtype=np.int64)
    T_ego_lidar = _pose_by_token(tables / "calibrated_sensor.json", {rows[0]["calibrated_sensor_token"]})
    egos = _pose_by_token(tables / "ego_pose.json", {row["ego_pose_token"] for row in rows})
    try:
        mounting = T_ego_lidar[rows[0]["calibrated_sensor_token"]]
        poses = np.array([egos[row["ego_pose_token"]] for row in rows]) @ mounting
    except KeyError as error:
        raise DataError(f"{tables}: no row {error} in calibrated_sensor.json or ego_pose.json") from None
    return Recording(
        folder=root,
        paths=tuple(root / str(row["filename"]) for row in rows),
        stamps_ns=stamps,
        layout=_LAYOUT,
        imu=_imu(root / f"can_bus/{scene.name}_ms_imu.json", notes),
        T_imu_lidar=mounting,
        poses=in_order(stamps, poses, str(tables / "ego_pose.json"), notes),
    )


def _time_us(path: Path, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > _LARGEST_US:
        raise DataError(f"{path}: expected a time in whole microseconds, got {str(value)[:40]}")
    return value


def _pose_by_token(path: Path, tokens: set[Any]) -> dict[Any, Array]:
    """Return the poses ``(4, 4)`` of rows with ``rotation`` (w x y z) and ``translation``, by token."""
    poses = {}
    for row in _rows(path, "token", "rotation", "translation"):
        if row["token"] not in tokens:
            continue
        quaternion, position = _numbers(path, row["rotation"], 4), _numbers(path, row["translation"], 3)
        (poses[row["token"]],) = poses_of(position[None], np.roll(quaternion, -1)[None], f"{path}: {row['token']}")
    return poses


def _numbers(path: Path, value: Any, count: int) -> Array:
    try:
        numbers = np.array(value, dtype=np.float64)
    except (ValueError, TypeError):
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise DataError(f"{path}: expected {count} finite numbers, got {str(value)[:80]}")
    return numbers


def _imu(path: Path, notes: Notes) -> ImuSamples:
    if not path.is_file():
        notes.add(f"no inertial data: {path} of the CAN bus extension does not exist")
        return ImuSamples.empty()
    rows = _rows(path, "utime", "rotation_rate", "linear_accel")
    values = [np.hstack([_numbers(path, row[key], 3) for key in ("rotation_rate", "linear_accel")]) for row in rows]
    notes.add("the IMU's frame is taken for the vehicle's (ego): nuScenes does not publish where the IMU is mounted")
    stamps = np.array([_time_us(path, row["utime"]) * US for row in rows], dtype=np.int64)
    return clean_imu(str(path), stamps, np.array(values).reshape(-1, 6), notes)


LAYOUT = Layout("nuScenes: v1.0-*/scene.json beside samples/ and sweeps/", _is_root, _gather, listed=scenes)
