"""An object placed in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybridlio.simulation.world.shapes import Mesh

Build = Callable[[np.random.Generator], Mesh]


@dataclass(frozen=True, eq=False)
class Item:
    """An object in the world.

    Attributes:
        x, y: position in metres, world frame.
        yaw: rotation about z in radians.
        radius: of its outline, in metres.
        build: makes the mesh, when the object first comes into sight.
        number: of the random stream that decides its shape; by default its index in the world.
    """

    x: float
    y: float
    yaw: float
    radius: float
    build: Build
    number: int | None = None
