"""Lidars of the platforms: the rays of each sweep, in the order in which they are sent.

Ranges and noise are those of data sheets, rounded. Every sweep is stamped at its start, as the drivers of Ouster and
Livox do, and every point has its time. The range is limited by the sensor's largest range alone: that at which a data
sheet promises dark surfaces (10 %) is not modelled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import NS_PER_S
from hybridlio.simulation.sensors.lidar import RayPattern, ray_pattern

# Rotation of the two prisms of a Livox Mid-40, revolutions per second (7294 and -4664 per minute: Liu, Zhang and Hong,
# "Low-cost retina-like robotic lidars based on incommensurable scanning", T-Mech 2021)
_PRISM_HZ = (7294 / 60, -4664 / 60)
# A Mid-360 turns its mirror about ten times a second while the beams sweep through the elevations. Frequencies without
# a common divisor, so that no sweep repeats another; the real pattern is not published as a formula.
_TURN_HZ, _NOD_HZ = 9.77, 463.0
_MID_360_DEG = (-7.0, 52.0)  # data sheet

# A mirror that moves in two axes looks along rows, from the lowest to the highest. Field of view of RoboSense's M1
# (data sheet), which has twice the resolution in both directions.
_RASTER_DEG, _RASTER_COLUMNS, _RASTER_ROWS = (120.0, 25.0), 300, 63


@dataclass(frozen=True)
class Scanner:
    """A lidar of a platform.

    Attributes:
        description: in words.
        model: ranges and noise.
        sweep: returns the rays of a sweep that starts at a time, in seconds.
    """

    description: str
    model: LidarModel
    sweep: Callable[[float], RayPattern]


def _spinning(description: str, model: LidarModel) -> Scanner:
    turn = ray_pattern(model)
    from_start = RayPattern(turn.directions, turn.column, turn.column_offset_ns - turn.column_offset_ns[0])
    return Scanner(description, model, lambda _: from_start)


def _ray_by_ray(times_s: Array, azimuth: Array, elevation: Array) -> RayPattern:
    """Return a pattern in which each ray has a time of its own; angles ``(R,)`` in radians."""
    flat = np.cos(elevation)
    directions = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    offsets = np.round((times_s - times_s[0]) * NS_PER_S).astype(np.int64)
    return RayPattern(directions, np.arange(len(times_s)), offsets)


def _mid_360_sweep(start_s: float) -> RayPattern:
    times = start_s + np.arange(20_000) / 200_000.0
    nod = 2 * np.abs((_NOD_HZ * times) % 1.0 - 0.5)  # a triangle wave: elevations are equally frequent
    low, high = np.radians(_MID_360_DEG)
    return _ray_by_ray(times, 2 * np.pi * _TURN_HZ * times, low + (high - low) * nod)


def _rosette_sweep(start_s: float) -> RayPattern:
    times = start_s + np.arange(24_000) / 240_000.0
    prisms = np.radians(70.0) / 4 * np.exp(2j * np.pi * np.outer(times, _PRISM_HZ))  # each bends by half the half angle
    off_axis = prisms.sum(axis=1)
    return _ray_by_ray(times, off_axis.real, off_axis.imag)


def _raster_sweep(_: float) -> RayPattern:
    row, place = np.divmod(np.arange(_RASTER_ROWS * _RASTER_COLUMNS), _RASTER_COLUMNS)
    across = (place + 0.5) / _RASTER_COLUMNS - 0.5
    azimuth = np.radians(_RASTER_DEG[0]) * np.where(row % 2 == 0, across, -across)  # to and fro
    elevation = np.radians(_RASTER_DEG[1]) * ((row + 0.5) / _RASTER_ROWS - 0.5)
    return _ray_by_ray(np.arange(len(row)) / (10.0 * len(row)), azimuth, elevation)


def _even(high_deg: float, low_deg: float, beams: int) -> tuple[float, ...]:
    return tuple(np.linspace(high_deg, low_deg, beams).tolist())


SCANNERS: dict[str, Scanner] = {
    "os0": _spinning(
        "64 beams × 1024, ±45°, like Ouster's OS0",
        LidarModel("os0", _even(45.0, -45.0, 64), 1024, 0.3, 75.0, 0.015, 0.02),
    ),
    "os1": _spinning(
        "64 beams × 1024, ±22.5°, like Ouster's OS1",
        LidarModel("os1", _even(22.5, -22.5, 64), 1024, 0.5, 120.0, 0.015, 0.02),
    ),
    "pandar": _spinning(
        "32 beams × 2000, +15° to -16°, like Hesai's PandarXT-32",
        LidarModel("pandar", _even(15.0, -16.0, 32), 2000, 0.05, 120.0, 0.01, 0.02),
    ),
    "hdl-64e": _spinning("64 beams × 1875, +2° to -24°, like Velodyne's HDL-64E", LIDAR_MODELS["hdl-64e"]),
    "vlp-16": _spinning("16 beams × 1800, ±15°, like Velodyne's VLP-16", LIDAR_MODELS["16-beam"]),
    "mid360": Scanner(
        "360° × 59°, not repetitive, 20,000 points, like Livox's Mid-360",
        LidarModel("mid360", (), 0, 0.1, 70.0, 0.02, 0.02),
        _mid_360_sweep,
    ),
    "rosette": Scanner(
        "70° to the front, not repetitive, 24,000 points, like Livox's Avia",
        LidarModel("rosette", (), 0, 1.0, 190.0, 0.02, 0.02),
        _rosette_sweep,
    ),
    "raster": Scanner(
        "120° × 25° to the front, in rows, 18,900 points, like RoboSense's M1",
        LidarModel("raster", (), 0, 0.5, 150.0, 0.02, 0.02),
        _raster_sweep,
    ),
}
