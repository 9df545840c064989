"""Place recognition: a descriptor of the heights around each keyframe, compared over all headings.

After scan context (Kim, Kim, "Scan Context: Egocentric Spatial Descriptor for Place Recognition within 3D Point Cloud
Map", IROS 2018): rings by distance, sectors by direction, the highest point in each cell. Rotating the sensor shifts
the sectors, so a circular correlation compares all headings at once, and the mean of each ring (the ring key) does not
depend on the heading. Two departures from the paper: descriptors are of several merged scans, so that a lidar with few
beams sees enough; and each place is also described from positions beside the path, as seen from the other lane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array, Floats
from hybridlio.core.setting_checks import check_positive, check_setting

_GROUND_PERCENTILE = 5.0  # of heights; the ground is the lowest surface, but reflections put a few points below it
_EMPTY_SECTOR = 1e-6  # length below which a sector is empty: heights are fractions of height_m


@dataclass(frozen=True)
class DescriptorSettings:
    """How places are described.

    Attributes:
        rings, sectors: number of cells by distance and by direction; as in the paper.
        range_m: points farther away are left out.
        height_m: heights above the ground count up to here.
        beside_m: positions left of the path (negative: right) from which a place is described; 3.5 m is a lane.

    Raises:
        SettingError: a value is out of range.
    """

    rings: int = 20
    sectors: int = 60
    range_m: float = 70.0
    height_m: float = 8.0
    beside_m: tuple[float, ...] = (0.0, 3.5, -3.5)

    def __post_init__(self) -> None:
        check_positive(self, "rings", "sectors", "range_m", "height_m")
        check_setting(self, "beside_m", len(self.beside_m) > 0, "one position at least")


def place_descriptor(points: Array, settings: DescriptorSettings) -> Floats:
    """Return the heights ``(rings, sectors)`` above ground, 0 to 1, around the origin; 0 in empty cells.

    Args:
        points: ``(N, 3)`` metres, z up.
        settings: cells and ranges.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    near = distance < settings.range_m
    points, distance = points[near], distance[near]
    heights = np.zeros(settings.rings * settings.sectors, np.float32)
    if not len(points):
        return heights.reshape(settings.rings, settings.sectors)
    ground = np.percentile(points[:, 2], _GROUND_PERCENTILE)
    height = np.clip(points[:, 2] - ground, 0.0, settings.height_m) / settings.height_m
    ring = (distance / settings.range_m * settings.rings).astype(np.intp)
    angle = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    sector = np.floor(angle * settings.sectors).astype(np.intp) % settings.sectors
    np.maximum.at(heights, ring * settings.sectors + sector, height.astype(np.float32))
    return heights.reshape(settings.rings, settings.sectors)


def ring_key(descriptors: Floats) -> Floats:
    """Return the mean of each ring ``(…, rings)`` of descriptors ``(…, rings, sectors)``, invariant to the heading."""
    return np.asarray(descriptors.mean(axis=-1))


def descriptor_spectrum(descriptors: Floats) -> NDArray[np.complex64]:
    """Return descriptors ``(…, rings, sectors)`` prepared for :func:`descriptor_distances`.

    Each sector is scaled to unit length and the whole by its number of occupied sectors, so that the correlation of
    two descriptors is their mean cosine similarity; then the sectors are Fourier transformed.
    """
    length = np.linalg.norm(descriptors, axis=-2, keepdims=True)
    occupied = np.maximum((length > _EMPTY_SECTOR).sum(axis=-1, keepdims=True), 1)
    units = descriptors / np.maximum(length, _EMPTY_SECTOR) / np.sqrt(occupied)
    return np.fft.rfft(units, axis=-1).astype(np.complex64)


def descriptor_distances(
    query: NDArray[np.complex64], others: NDArray[np.complex64], sectors: int
) -> tuple[Floats, Floats]:
    """Compare a place with others, each at the heading of greatest similarity.

    Args:
        query: ``(R, F)`` from :func:`descriptor_spectrum`.
        others: ``(C, R, F)``.
        sectors: of the descriptors.

    Returns:
        distances ``(C,)`` between 0 (equal) and 1, and yaws ``(C,)`` in radians: the query's heading in the other's
        frame.
    """
    correlation = np.fft.irfft((np.conj(query) * others).sum(axis=-2), n=sectors, axis=-1)
    shift = correlation.argmax(axis=-1)
    best = np.take_along_axis(correlation, shift[:, None], axis=-1)[:, 0]
    yaw = (shift * (2 * np.pi / sectors) + np.pi) % (2 * np.pi) - np.pi
    return (1 - best).astype(np.float32), yaw.astype(np.float32)
