"""Beams, ranges and noise of known lidars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LidarModel:
    """Beams, ranges and noise of a spinning lidar.

    Attributes:
        name: name of the preset, such as ``hdl-64e``.
        elevations_deg: one per beam, from the top.
        columns: azimuth steps per revolution.
        min_range_m, max_range_m: no returns outside this range.
        range_sigma_m: standard deviation of a range.
        dropout: fraction of beams that hit something but return nothing.
        rate_hz: revolutions per second.
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    min_range_m: float
    max_range_m: float
    range_sigma_m: float
    dropout: float
    rate_hz: float = 10.0

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.elevations_deg)


def _hdl_64e_elevations() -> tuple[float, ...]:
    # Velodyne HDL-64E S2 user's manual: 32 upper lasers every 1/3° from +2°, 32 lower every 1/2° from -8.83° to -24.33°
    upper = np.linspace(2.0, -8.33, 32)
    lower = np.linspace(-8.83, -24.33, 32)
    return tuple(float(e) for e in np.concatenate([upper, lower]))


# hdl-64e: KITTI's sensor. 16-beam: the VLP-16's data sheet (±15°, 100 m, 3 cm). 32-beam: the VLP-32C's field of view
# with evenly spaced beams.
LIDAR_MODELS: dict[str, LidarModel] = {
    "hdl-64e": LidarModel("hdl-64e", _hdl_64e_elevations(), 1875, 1.5, 120.0, 0.02, 0.03),
    "32-beam": LidarModel("32-beam", tuple(np.linspace(15.0, -25.0, 32).tolist()), 1800, 1.0, 100.0, 0.02, 0.03),
    "16-beam": LidarModel("16-beam", tuple(np.linspace(15.0, -15.0, 16).tolist()), 1800, 0.5, 100.0, 0.03, 0.03),
}
