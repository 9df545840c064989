"""The ground: rolling land, and on it the road with camber, curbs and sidewalks.

Cross-section of a European residential street, by common road design values: 11 m between curbs (two lanes of 3.5 m
and two of 2 m for parking), 2 % camber, curbs of 12 cm, sidewalks of 2 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.shapes import Mesh

Height = Callable[[Array], Array]

CURB_OFFSET_M = 5.5  # from the centreline, as all offsets
CURB_HEIGHT_M = 0.12  # usual are 0.10 to 0.15 m
CAMBER = 0.02  # slope of the road to either side, for drainage
SIDEWALK_END_M = 7.5  # from the centreline: the sidewalk is 2 m wide
_VERGE_M = 1.5  # width over which paved ground turns into unpaved, and the sidewalk's height ends
_ASPHALT, _PAVING, _GRASS = 0.22, 0.32, 0.42  # reflectances, plausible at 905 nm; only their order matters


def waves(rng: np.random.Generator, count: int, lengths_m: tuple[float, float], slope: float) -> Height:
    """Return a smooth random surface: ``count`` plane waves of log-uniform length, of total rms slope ``slope``."""
    length = np.exp(rng.uniform(np.log(lengths_m[0]), np.log(lengths_m[1]), count))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, count))
    k = 2 * np.pi / length
    amplitude = slope * np.sqrt(2 / count) / k
    wave = np.stack([k * np.cos(angle), k * np.sin(angle)])

    def height(xy: Array) -> Array:
        return np.asarray(np.sin(xy @ wave + phase) @ amplitude)

    return height


def land_along(points: Array, margin_m: float = 150.0, cell_m: float = 4.0) -> Height:
    """Return land that passes through ``points`` ``(N, 3)`` and is smooth away from them.

    Heights are spread on a grid by normalised convolution (Knutsson and Westin, CVPR 1993), with kernels from wide to
    narrow; each replaces the wider one where it has enough weight.
    """
    origin = points[:, :2].min(axis=0) - margin_m
    shape = tuple(np.ceil((np.ptp(points[:, :2], axis=0) + 2 * margin_m) / cell_m).astype(int) + 1)
    index = np.round((points[:, :2] - origin) / cell_m).astype(int)
    total, weight = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (index[:, 0], index[:, 1]), points[:, 2])
    np.add.at(weight, (index[:, 0], index[:, 1]), 1.0)
    surface = np.full(shape, float(points[:, 2].mean()))
    for sigma in (128.0, 32.0, 8.0, 2.0, 1.0):  # cells
        smooth_total, smooth_weight = (gaussian_filter(a, sigma, mode="constant") for a in (total, weight))
        trust = smooth_weight / (smooth_weight + 1e-3 / sigma)
        surface = (1 - trust) * surface + trust * smooth_total / np.maximum(smooth_weight, 1e-12)

    def height(xy: Array) -> Array:
        return np.asarray(map_coordinates(surface, ((xy - origin) / cell_m).T, order=3, mode="nearest"))

    return height


@dataclass(frozen=True, eq=False)
class Ground:
    """Height of the ground as the sum of land, road profile and unevenness.

    Attributes:
        land: the large shape; metres at positions ``(N, 2)``.
        roughness: unevenness of unpaved ground.
        pavement: unevenness of the road.
        centre: k-d tree of points ``(x, y)`` on the centrelines, half a metre apart.
        curbs: whether the road has curbs and sidewalks.
    """

    land: Height
    roughness: Height
    pavement: Height
    centre: cKDTree
    curbs: bool = True

    def distance(self, xy: Array) -> Array:
        """Return the distance ``(N,)`` in metres to the nearest centreline."""
        return np.asarray(self.centre.query(xy, workers=1)[0])

    def height(self, xy: Array) -> Array:
        """Return the height ``(N,)`` of the ground at positions ``(N, 2)``."""
        d = self.distance(xy)
        unpaved = np.clip((d - SIDEWALK_END_M) / _VERGE_M, 0.0, 1.0)
        profile = -CAMBER * np.minimum(d, CURB_OFFSET_M)
        if self.curbs:
            profile = profile + CURB_HEIGHT_M * ((d > CURB_OFFSET_M) & (d < SIDEWALK_END_M + _VERGE_M))
        return self.land(xy) + profile + (1 - unpaved) * self.pavement(xy) + unpaved * self.roughness(xy)

    def patch(self, low: Array, size_m: float, cell_m: float) -> Mesh:
        """Return the square from corner ``low`` ``(2,)`` to ``low + size_m`` as a regular grid of triangles."""
        count = round(size_m / cell_m)
        axis = np.linspace(0.0, size_m, count + 1)
        xy = np.stack(np.meshgrid(low[0] + axis, low[1] + axis, indexing="ij"), axis=-1).reshape(-1, 2)
        corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).reshape(-1)
        lower = np.column_stack([corner, corner + count + 1, corner + count + 2])
        upper = np.column_stack([corner, corner + count + 2, corner + 1])
        triangles = np.concatenate([lower, upper])
        vertices = np.column_stack([xy, self.height(xy)])
        d = self.distance(vertices[triangles, :2].mean(axis=1))
        paved = np.where(d < CURB_OFFSET_M, _ASPHALT, np.where(d < SIDEWALK_END_M, _PAVING, _GRASS))
        return Mesh(vertices, triangles, paved)
