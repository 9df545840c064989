"""Scans inside an empty box, by intersecting rays with its six sides."""

import numpy as np


def directions(beams: int, columns: int, half_fov_deg: float) -> np.ndarray:
    """Return unit vectors ``(beams·columns, 3)`` of a spinning lidar, lidar frame."""
    elevation = np.radians(np.linspace(-half_fov_deg, half_fov_deg, beams))
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    return np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def box_ranges(position: np.ndarray, rays: np.ndarray, size: tuple[float, float, float]) -> np.ndarray:
    """Return distances ``(N,)`` along rays ``(N, 3)`` from inside a box with a corner at the origin."""
    with np.errstate(divide="ignore"):
        to_side = np.where(rays > 0, (np.array(size) - position) / rays, -position / rays)
    return np.asarray(to_side.min(axis=1))
