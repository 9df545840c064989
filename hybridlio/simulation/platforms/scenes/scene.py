"""A scene: one mesh, and a way through it that stays clear of everything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.rays import RayScene
from hybridlio.simulation.world.shapes import Mesh


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands still in a world, and the way through it.

    Attributes:
        mesh: all surfaces, world frame.
        way: ``(N, 3)`` corners of the way, on the floor. It is as long as was asked for, or closed.
        closed: whether the way ends where it begins.
        headroom_m: height of the lowest ceiling over the way; infinite outdoors.
        speed_m_s: limit for fast bodies.
    """

    mesh: Mesh
    way: Array
    closed: bool
    headroom_m: float = np.inf
    speed_m_s: float = np.inf

    def rays(self) -> RayScene:
        """Build the ray-casting scene."""
        centre = (self.mesh.vertices.min(axis=0) + self.mesh.vertices.max(axis=0)) / 2
        return RayScene.of(self.mesh, np.round(centre))


BuildScene = Callable[[np.random.Generator, float], Scene]
"""Makes a scene from random numbers and the length of the way that is needed, in metres."""


def clearance(points: Array, way: Array) -> Array:
    """Return the horizontal distance ``(P,)`` of points ``(P, 2+)`` from the line through ``way`` ``(N, 2+)``."""
    points, start, end = points[:, None, :2], way[None, :-1, :2], way[None, 1:, :2]
    along = end - start
    share = ((points - start) * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.asarray(np.linalg.norm(points - nearest, axis=-1).min(axis=1))
