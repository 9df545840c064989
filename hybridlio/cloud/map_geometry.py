"""The cells of a map of a scan: a division of the sphere of directions into rows and columns."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.core.errors import ConfigError
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel

_MOST_CELLS = 10_000_000  # a lidar gives a million points a scan at most; a damaged file may announce any number


@dataclass(frozen=True)
class MapGeometry:
    """Division of the sphere of directions into cells.

    Attributes:
        fov_up_deg: elevation of the upper edge of row 0.
        fov_down_deg: elevation of the lower edge of the last row.
        rows, columns: H and W; columns cover the full circle, from azimuth +180° (behind) over +90° (left) to −180°.
    """

    fov_up_deg: float
    fov_down_deg: float
    rows: int
    columns: int

    def __post_init__(self) -> None:
        if not -90.0 <= self.fov_down_deg < self.fov_up_deg <= 90.0:
            raise ConfigError(
                f"map geometry: need -90 <= fov_down_deg < fov_up_deg <= 90, got {self.fov_down_deg}, {self.fov_up_deg}"
            )
        if self.rows < 1 or self.columns < 1:
            raise ConfigError(f"map geometry: rows and columns must be at least 1, got {self.rows} x {self.columns}")
        if self.rows * self.columns > _MOST_CELLS:
            raise ConfigError(f"map geometry: {self.rows} x {self.columns} cells; at most {_MOST_CELLS} are of use")

    @property
    def row_deg(self) -> float:
        """η_h, the height of a cell in degrees."""
        return (self.fov_up_deg - self.fov_down_deg) / self.rows

    @property
    def column_deg(self) -> float:
        """η_w, the width of a cell in degrees."""
        return 360.0 / self.columns

    @classmethod
    def by_beam(cls, lidar: LidarModel, columns: int = 720) -> MapGeometry:
        """Return a geometry with one row per beam, beams in the middle of rows, for evenly spaced beams."""
        top, bottom = max(lidar.elevations_deg), min(lidar.elevations_deg)
        half = (top - bottom) / (lidar.beams - 1) / 2 if lidar.beams > 1 else 0.5
        return cls(top + half, bottom - half, lidar.beams, columns)


MAP_GEOMETRIES: dict[str, MapGeometry] = {
    "hdl-64e": MapGeometry(3.0, -23.0, 52, 720),  # the paper's: 0.5° in both directions
    "32-beam": MapGeometry.by_beam(LIDAR_MODELS["32-beam"]),
    "16-beam": MapGeometry.by_beam(LIDAR_MODELS["16-beam"]),
}


def map_geometry(lidar: str) -> MapGeometry:
    """Return the preset of a lidar by name.

    Raises:
        ConfigError: there is no preset of that name.
    """
    if lidar not in MAP_GEOMETRIES:
        raise ConfigError(
            f"no map geometry named {lidar!r}; known are {', '.join(MAP_GEOMETRIES)}; or give fov and cells"
        )
    return MAP_GEOMETRIES[lidar]
