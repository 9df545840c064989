"""Objects that move through the world: cars and people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.simulation.world.items import Build
from hybridlio.simulation.world.rays import RayScene
from hybridlio.simulation.world.shapes import Mesh

_REACH_M = 90.0  # farther, a dark object returns almost nothing


@dataclass(eq=False)
class MovingObject:
    """A rigid object that moves upright.

    Attributes:
        motion: ``(x, y, z, heading)`` in world over the seconds that the object is there; it stands at z.
        shape_seed: decides its shape.
        build: makes the shape, z up, x ahead.
        middle_m: height of its middle.
        radius_m: of a sphere about the middle that contains it.
    """

    motion: CubicSpline
    shape_seed: tuple[int, ...]
    build: Build
    middle_m: float
    radius_m: float
    _scene: RayScene | None = None

    def present(self, time_s: float) -> bool:
        """Return whether the object is there at ``time_s``."""
        return bool(self.motion.x[0] <= time_s <= self.motion.x[-1])

    def poses(self, times_s: Array) -> Array:
        """Return ``T_world_object`` ``(N, 4, 4)``, constant before and after its time."""
        x, y, z, heading = self.motion(np.clip(times_s, self.motion.x[0], self.motion.x[-1])).T
        c, s, zero, one = np.cos(heading), np.sin(heading), np.zeros_like(x), np.ones_like(x)
        R = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
        return se3.make(R, np.stack([x, y, z], axis=-1))

    @property
    def mesh(self) -> Mesh:
        """The shape, in the object's own frame."""
        return self.build(np.random.default_rng(self.shape_seed))

    @property
    def scene(self) -> RayScene:
        """The shape, ready for ray casting."""
        if self._scene is None:
            self._scene = RayScene.of(self.mesh, np.zeros(3))
        return self._scene


def in_reach(objects: Sequence[MovingObject], position: Array, time_s: float) -> list[MovingObject]:
    """Return the objects that can be seen from ``position`` ``(3,)``, world frame, at ``time_s``."""
    near = []
    for thing in objects:
        if thing.present(time_s):
            at = thing.poses(np.array([time_s]))[0, :3, 3]
            if np.linalg.norm(at - position) < _REACH_M:
                near.append(thing)
    return near
