"""The file ``calibration.yaml`` of a plain folder: extrinsics, sensors, and what the files' columns mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.files import read_yaml
from hybridlio.core.imu_scale import KNOWN_SCALE_SIGMA, ImuScale
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import MAX_RANGE_M, Calibration, ImuNoise
from hybridlio.core.setting_checks import SettingError
from hybridlio.datasets.points.bin_layout import BinLayout, stated_layout
from hybridlio.datasets.points.point_format import Box, StatedFormat
from hybridlio.datasets.points.point_times import NORMALISED, ORIGINS, UNITS_NS, StatedTimes
from hybridlio.datasets.rosbag.transforms import FrameTree
from hybridlio.datasets.transform_forms import HOW_TO_WRITE, parse_transform

_KEYS = (
    *("T_imu_lidar", "T_camera_lidar", "lidar", "antenna_imu_m", "imu_time_offset_s", "imu_noise", "rate_hz"),
    *("columns", "point_times", "vehicle", "frames", "imu_frame", "lidar_frame", "lidars"),
    *("imu_scale", "sigmas"),
)
_LIDAR_KEYS = ("model", "min_range_m", "max_range_m")
_VEHICLE_KEYS = ("min", "max")
_SCALE_KEYS = ("gyro", "accel")
_FRAME_KEYS = ("parent", "child")
_TIMES_KEYS = ("column", "unit", "origin", "sweep_s")
_MAX_TIME_OFFSET_S = 1e10  # of clocks that count from different years; larger ones are another unit
MAX_RATE_HZ = 500.0  # of scans; stamps under 2 ms apart are another unit
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class StatedCalibration:
    """What a ``calibration.yaml`` states; None where it is silent.

    Attributes:
        calibration: the extrinsics.
        lidar: the lidar's model.
        imu_noise: the IMU's noise densities.
        imu_time_offset_s: to add to the IMU's stamps to bring them to the scans' clock.
        imu_scale: scale and misalignment of the IMU's axes.
        rate_hz: scans per second, for a folder without stamps.
        layout: the columns of ``.bin`` scans.
        format: what is stated about the points.
        lidars: poses of further lidars in the first one's frame, by their topics or folders.
        keys: the keys that are in the file; ``T_imu_lidar`` also where frames state it.
    """

    calibration: Calibration = field(default_factory=Calibration)
    lidar: LidarModel | None = None
    imu_noise: ImuNoise | None = None
    imu_time_offset_s: float | None = None
    imu_scale: ImuScale = field(default_factory=ImuScale)
    rate_hz: float | None = None
    layout: BinLayout | None = None
    format: StatedFormat = field(default_factory=StatedFormat)
    lidars: dict[str, Array] = field(default_factory=dict)
    keys: frozenset[str] = frozenset()


def read_calibration_yaml(path: Path, needs_imu: bool = False) -> StatedCalibration:
    """Read a ``calibration.yaml``.

    Keys, all optional:

    * ``T_imu_lidar`` and ``T_camera_lidar``: transforms in any form of :mod:`hybridlio.datasets.transform_forms`;
      without ``T_imu_lidar`` it is the identity;
    * ``antenna_imu_m``: the GPS antenna in the IMU frame, three numbers;
    * ``lidar``: a name of :data:`hybridlio.core.lidar_models.LIDAR_MODELS`, or a mapping of ``model``, ``min_range_m``
      and ``max_range_m``; points outside stated ranges are left out;
    * ``imu_time_offset_s``: seconds to add to the IMU's stamps to bring them to the scans' clock; without it the
      offset is found before a run;
    * ``imu_scale``: matrices ``gyro`` and ``accel`` that bring the samples to true scale and orthogonal axes, see
      :class:`hybridlio.core.imu_scale.ImuScale`;
    * ``imu_noise``: noise densities by the names of :class:`hybridlio.core.sensors.ImuNoise`; with ``imu_scale`` the
      default of ``gyro_scale_sigma`` is 0.003;
    * ``frames``, ``imu_frame`` and ``lidar_frame``: in place of ``T_imu_lidar``, a list of transforms between frames as
      in a TF tree, each ``parent``, ``child`` and the child's pose in the parent, and the names of the sensors' frames;
    * ``lidars``: where several lidars are merged, the pose of each further one in the first one's frame, by its topic
      or the folder of its scans, in any form of a transform;
    * ``vehicle``: a box in the lidar frame, corners ``min`` and ``max`` in metres, whose points are left out;
    * ``sigmas``: standard deviations as ``hybridlio calibrate`` writes them, for the reader's information alone;
    * ``rate_hz``: scans per second, for a folder without a file of stamps;
    * ``columns``: see :func:`hybridlio.datasets.points.bin_layout.stated_layout`;
    * ``point_times``: ``none``, or a mapping of the attributes of
      :class:`hybridlio.datasets.points.point_times.StatedTimes`.

    Args:
        path: the file, which need not exist.
        needs_imu: whether there are inertial data, which need ``T_imu_lidar``.

    Raises:
        DataError: the file is not YAML, a key or value is unknown, a transform is not rigid, or ``T_imu_lidar`` is
            needed and missing; the message names the file.
    """
    content = read_yaml(path) if path.is_file() else {}
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected a mapping; {HOW_TO_WRITE}")
    if unknown := [key for key in content if key not in _KEYS]:
        raise DataError(f"{path}: unknown key {unknown[0]!r}; the keys are {', '.join(_KEYS)}")
    if content.get("T_imu_lidar") is None and content.get("frames") is None and needs_imu:
        what = "lacks T_imu_lidar" if path.is_file() else "missing"
        raise DataError(f"{path}: {what}, and imu.csv needs it: {HOW_TO_WRITE}")
    try:
        return _stated(content)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _stated(content: dict[str, Any]) -> StatedCalibration:
    def read(key: str, parse: Callable[[str, Any], _T], default: _T) -> _T:
        value = content.get(key)
        return default if value is None else parse(key, value)

    identity: Array = np.eye(4)
    T_imu_lidar = read("T_imu_lidar", parse_transform, identity)
    stated = {key for key, value in content.items() if value is not None}
    if tree := stated & {"frames", "imu_frame", "lidar_frame"}:
        if "T_imu_lidar" in stated:
            raise DataError(f"T_imu_lidar and {min(tree)} state the same; keep one of them")
        T_imu_lidar = _by_frames(content)
        stated.add("T_imu_lidar")
    T_camera_lidar = read("T_camera_lidar", parse_transform, None)
    lidar, limits_m = _lidar("lidar", content["lidar"]) if content.get("lidar") is not None else (None, None)
    return StatedCalibration(
        calibration=Calibration(T_imu_lidar, T_camera_lidar, read("antenna_imu_m", _position, None)),
        lidar=lidar,
        imu_noise=_stated_noise(content),
        imu_time_offset_s=read("imu_time_offset_s", _time_offset_s, None),
        imu_scale=read("imu_scale", _imu_scale, ImuScale()),
        rate_hz=read("rate_hz", lambda key, value: _number(key, value, 0, MAX_RATE_HZ), None),
        layout=read("columns", lambda _, value: stated_layout(value), None),
        format=StatedFormat(read("point_times", _point_times, None), limits_m, read("vehicle", _vehicle, None)),
        lidars=read("lidars", _lidars, {}),
        keys=frozenset(stated),
    )


def _time_offset_s(key: str, value: Any) -> float:
    return _number(key, value, -_MAX_TIME_OFFSET_S, _MAX_TIME_OFFSET_S)


def _number(key: str, value: Any, above: float, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not above < value <= most:
        raise DataError(f"{key}: expected a number above {above:g} and up to {most:g}, got {value!r}")
    return float(value)


def _mapping(key: str, value: Any, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, dict) or (unknown := [name for name in value if name not in keys]):
        what = f"unknown key {unknown[0]!r}" if isinstance(value, dict) else f"got {value!r}"
        raise DataError(f"{key}: expected a mapping of {', '.join(keys)}; {what}")
    return value


def _position(key: str, value: Any) -> Array:
    return se3.check_position(value, key)


def _vehicle(key: str, value: Any) -> Box:
    parts = _mapping(key, value, _VEHICLE_KEYS)
    low, high = (_position(f"{key}: {name}", parts.get(name)) for name in _VEHICLE_KEYS)
    if not (low < high).all():
        raise DataError(f"{key}: each number of min must be below that of max, got {low.tolist()} and {high.tolist()}")
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def _by_frames(content: dict[str, Any]) -> Array:
    """Return ``T_imu_lidar`` from a tree of frames and the names of the sensors' frames."""
    tree, edges = FrameTree(), content.get("frames")
    if not isinstance(edges, list):
        raise DataError("frames: expected a list of transforms, each with parent, child, translation and a rotation")
    for number, edge in enumerate(edges):
        if not isinstance(edge, dict) or not set(_FRAME_KEYS) < set(edge):
            raise DataError(f"frames: entry {number} lacks parent, child or the child's pose in the parent")
        parent, child = (str(edge[key]) for key in _FRAME_KEYS)
        pose = {key: part for key, part in edge.items() if key not in _FRAME_KEYS}
        T_parent_child = parse_transform(f"frames: entry {number}", pose.get("T_parent_child", pose))
        tree.connect(parent, child, T_parent_child)
    imu, lidar = content.get("imu_frame"), content.get("lidar_frame")
    if imu is None or lidar is None:
        raise DataError("frames need imu_frame and lidar_frame, the names of the sensors' frames")
    T = tree.find(str(imu), str(lidar))
    if T is None:
        raise DataError(f"frames do not connect {imu!r} and {lidar!r}; they are {', '.join(tree.names())}")
    return T


def _lidar(key: str, value: Any) -> tuple[LidarModel | None, tuple[float, float] | None]:
    parts = {"model": value} if isinstance(value, str) else _mapping(key, value, _LIDAR_KEYS)
    name = parts.get("model")
    if name is not None and str(name) not in LIDAR_MODELS:
        raise DataError(f"unknown lidar {name!r}; known: {', '.join(LIDAR_MODELS)}")
    model = None if name is None else LIDAR_MODELS[str(name)]
    unlimited = {"min_range_m": 0.0, "max_range_m": MAX_RANGE_M}
    low, high = (
        _number(f"{key}: {limit}", parts.get(limit, every), -np.inf, MAX_RANGE_M) for limit, every in unlimited.items()
    )
    if not 0 <= low < high:
        raise DataError(f"{key}: expected 0 <= min_range_m < max_range_m, got {low:g} and {high:g}")
    if not {"min_range_m", "max_range_m"} & parts.keys():
        return model, None
    stated = {name: float(parts[name]) for name in _LIDAR_KEYS[1:] if name in parts}
    return None if model is None else replace(model, **stated), (low, high)  # type: ignore[arg-type]


def _lidars(key: str, value: Any) -> dict[str, Array]:
    if not isinstance(value, dict):
        raise DataError(f"{key}: expected a mapping of topics or folders to transforms, got {value!r}")
    return {str(name): parse_transform(f"{key}: {name}", part) for name, part in value.items()}


def _stated_noise(content: dict[str, Any]) -> ImuNoise | None:
    """Return the stated noise; the gyroscope's scale is known better where ``imu_scale`` states it."""
    values = content.get("imu_noise")
    noise = None if values is None else _imu_noise("imu_noise", values)
    if content.get("imu_scale") is None or "gyro_scale_sigma" in (values or {}):
        return noise
    return replace(noise or ImuNoise(), gyro_scale_sigma=KNOWN_SCALE_SIGMA)


def _imu_noise(key: str, value: Any) -> ImuNoise:
    values = _mapping(key, value, tuple(f.name for f in fields(ImuNoise)))
    try:
        return ImuNoise(**{name: _number(f"{key}: {name}", v, -np.inf, np.inf) for name, v in values.items()})
    except SettingError as error:
        raise DataError(f"{key}: {error}") from None


def _imu_scale(key: str, value: Any) -> ImuScale:
    matrices = _mapping(key, value, _SCALE_KEYS)
    try:
        return ImuScale(**{name: np.array(rows, dtype=np.float64) for name, rows in matrices.items()})
    except (ValueError, TypeError):
        raise DataError(f"{key}: expected matrices gyro and accel, each of three rows of three numbers") from None


def _point_times(key: str, value: Any) -> StatedTimes:
    if value in ("none", False):
        return StatedTimes(ignored=True)
    parts = _mapping(key, value, _TIMES_KEYS)
    unit = {"µs": "us", "normalized": NORMALISED}.get(parts.get("unit", ""), parts.get("unit"))
    for name, stated, known in (("unit", unit, (*UNITS_NS, NORMALISED)), ("origin", parts.get("origin"), ORIGINS)):
        if stated is not None and stated not in known:
            raise DataError(f"{key}: unknown {name} {stated!r}; one of {', '.join(known)}")
    column, sweep_s = parts.get("column"), parts.get("sweep_s")
    return StatedTimes(
        column=None if column is None else str(column).lower(),
        unit=unit,
        origin=parts.get("origin"),
        sweep_s=None if sweep_s is None else _number(f"{key}: sweep_s", sweep_s, 0, 1),
    )
