"""The scenes by name."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.simulation.platforms.scenes.campus import campus
from hybridlio.simulation.platforms.scenes.forest import forest
from hybridlio.simulation.platforms.scenes.halls import garage, warehouse
from hybridlio.simulation.platforms.scenes.house import house
from hybridlio.simulation.platforms.scenes.office import office
from hybridlio.simulation.platforms.scenes.room import room
from hybridlio.simulation.platforms.scenes.scene import BuildScene
from hybridlio.simulation.platforms.scenes.stairs import stairs
from hybridlio.simulation.platforms.scenes.underground import mine, tunnel


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
    "room": SceneKind("one furnished room of 5 by 4 m", room, "handheld"),
    "stairs": SceneKind("a stairwell over four storeys, with a small hall on each", stairs, "handheld"),
    "house": SceneKind("furnished rooms on two floors, with a staircase", house, "handheld"),
    "warehouse": SceneKind("racks of pallets 7 m high, and aisles", warehouse, "robot"),
    "garage": SceneKind("a level of a parking garage: columns, parked cars, a low ceiling", garage, "car"),
    "forest": SceneKind("trunks a few metres apart on uneven ground, with undergrowth", forest, "quadruped"),
    "tunnel": SceneKind("a road tunnel with smooth walls, lamps and cabinets", tunnel, "car"),
    "mine": SceneKind("a drift through rough rock, with timber sets and pipes", mine, "robot"),
    "campus": SceneKind("large buildings around lawns, with paths, trees and hedges", campus, "handheld"),
}
