"""Which places look alike: a polar picture of the heights around each keyframe, compared at every turn.

After scan context (Kim, Kim, IROS 2018): rings by distance, sectors by direction, in each cell the highest point. A
turn of the sensor shifts the sectors, so that all turns are compared at once by a circular correlation, and the rings'
means are the same whatever the turn. Two departures: the pictures are of several merged scans, so that a lidar of few
beams sees enough, and each place is also drawn from positions beside the path, as the other lane would see it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array, Floats
from hybridlio.core.setting_checks import check_positive, check_setting


@dataclass(frozen=True)
class DescriptorSettings:
    """How places are drawn.

    Attributes:
        rings, sectors: cells by distance and by direction.
        range_m: points farther away are left out.
        height_m: heights above the ground count up to here.
        beside_m: positions to the left of the path that a place is drawn from too.

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


def describe(points: Array, settings: DescriptorSettings) -> Floats:
    """The picture ``(rings, sectors)`` of points ``(N, 3)`` in metres, z up, seen from the origin; 0 in empty cells."""
    distance = np.hypot(points[:, 0], points[:, 1])
    near = distance < settings.range_m
    points, distance = points[near], distance[near]
    picture = np.zeros(settings.rings * settings.sectors, np.float32)
    if not len(points):
        return picture.reshape(settings.rings, settings.sectors)
    ground = np.percentile(points[:, 2], 5.0)
    height = np.clip(points[:, 2] - ground, 0.0, settings.height_m) / settings.height_m
    ring = (distance / settings.range_m * settings.rings).astype(np.intp)
    angle = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    sector = np.floor(angle * settings.sectors).astype(np.intp) % settings.sectors
    np.maximum.at(picture, ring * settings.sectors + sector, height.astype(np.float32))
    return picture.reshape(settings.rings, settings.sectors)


def ring_key(pictures: Floats) -> Floats:
    """``(…, rings)``: what of pictures ``(…, rings, sectors)`` no turn changes."""
    return np.asarray(pictures.mean(axis=-1))


def spectrum(pictures: Floats) -> NDArray[np.complex64]:
    """Pictures ``(…, rings, sectors)`` made ready to :func:`compare`: sectors of unit length, Fourier transformed."""
    length = np.linalg.norm(pictures, axis=-2, keepdims=True)
    seen = np.maximum((length > 1e-6).sum(axis=-1, keepdims=True), 1)
    units = pictures / np.maximum(length, 1e-6) / np.sqrt(seen)
    return np.fft.rfft(units, axis=-1).astype(np.complex64)


def compare(query: NDArray[np.complex64], others: NDArray[np.complex64], sectors: int) -> tuple[Floats, Floats]:
    """How unlike a place is to others, at the turn at which they are most alike.

    Args:
        query: ``(R, F)`` from :func:`spectrum`.
        others: ``(C, R, F)``.
        sectors: of the pictures.

    Returns:
        distances ``(C,)`` between 0 (the same) and 1, and yaws ``(C,)`` in radians: the query's heading in the other's
        frame.
    """
    correlation = np.fft.irfft((np.conj(query) * others).sum(axis=-2), n=sectors, axis=-1)
    shift = correlation.argmax(axis=-1)
    best = np.take_along_axis(correlation, shift[:, None], axis=-1)[:, 0]
    yaw = (shift * (2 * np.pi / sectors) + np.pi) % (2 * np.pi) - np.pi
    return (1 - best).astype(np.float32), yaw.astype(np.float32)
