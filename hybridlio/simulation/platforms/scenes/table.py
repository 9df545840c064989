"""The scenes by name."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.simulation.platforms.scenes.campus import campus
from hybridlio.simulation.platforms.scenes.office import office
from hybridlio.simulation.platforms.scenes.scene import BuildScene
from hybridlio.simulation.platforms.scenes.stairs import stairs


@dataclass(frozen=True)
class SceneKind:
    """A kind of scene.

    Attributes:
        description: in words.
        build: makes one.
        platform: what moves through it unless another is named.
    """

    description: str
    build: BuildScene
    platform: str


SCENES: dict[str, SceneKind] = {
    "office": SceneKind("an office floor: furnished rooms of 4 to 8 m, doors, corridors", office, "handheld"),
    "stairs": SceneKind("a stairwell over four storeys, with a small hall on each", stairs, "handheld"),
    "campus": SceneKind("large buildings around lawns, with paths, trees and hedges", campus, "handheld"),
}
