"""Scenes for registration: points on parallelograms, with normals."""

import numpy as np

from hybridlio.core import se3


def wall(
    rng: np.random.Generator, origin: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], count: int = 800
) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a parallelogram, and its normal for each."""
    a, b = np.array(u, float), np.array(v, float)
    points = np.array(origin, float) + rng.random((count, 1)) * a + rng.random((count, 1)) * b
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    return points, np.tile(normal, (count, 1))


FLOOR = ((-10, -8, -2), (20, 0, 0), (0, 16, 0))
NORTH, SOUTH = ((-10, 8, -2), (20, 0, 0), (0, 0, 5)), ((-10, -8, -2), (20, 0, 0), (0, 0, 5))
EAST, WEST = ((10, -8, -2), (0, 16, 0), (0, 0, 5)), ((-10, -8, -2), (0, 16, 0), (0, 0, 5))
ROOM, CORRIDOR, PLAIN = (FLOOR, NORTH, SOUTH, EAST, WEST), (FLOOR, NORTH, SOUTH), (FLOOR,)


def scene(rng: np.random.Generator, walls: tuple, count: int = 800) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals of several walls, ``count`` points each."""
    parts = [wall(rng, *w, count=count) for w in walls]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return world points in the frame of a sensor at ``pose`` ``(4, 4)``."""
    return se3.transform(se3.inverse(pose), points)
