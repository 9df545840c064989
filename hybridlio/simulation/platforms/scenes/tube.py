"""Tubes: a tunnel or a mine's drift, as a cross-section that is swept along a line."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.ground import Height
from hybridlio.simulation.world.shapes import Mesh, boxes, merge


def frames_along(line: Array) -> tuple[Array, Array]:
    """Return the arc length ``(N,)`` and the left-pointing normals ``(N, 2)`` of a line ``(N, 3)`` on the ground."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    ahead = np.gradient(line[:, :2], arc, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return arc, np.column_stack([-ahead[:, 1], ahead[:, 0]])


def tube(line: Array, profile: Array, reflectance: float, rough_m: float = 0.0, surface: Height | None = None) -> Mesh:
    """Sweep a closed profile ``(K, 2)`` (to the left, and up) along a line ``(N, 3)``.

    Args:
        line: on the ground; its first and last point may be the same.
        profile: as seen along the line, counter-clockwise.
        reflectance: of all faces.
        rough_m: by how much ``surface`` of slope 1 moves vertices outwards or inwards.
        surface: a random surface over arc length and the length along the profile.
    """
    arc, left = frames_along(line)
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    offsets = np.broadcast_to(profile, (len(line), *profile.shape))
    if surface is not None:
        centre = profile.mean(axis=0)
        outwards = (profile - centre) / np.linalg.norm(profile - centre, axis=1, keepdims=True)
        at = np.stack(np.meshgrid(arc, around, indexing="ij"), axis=-1).reshape(-1, 2)
        offsets = offsets + rough_m * surface(at).reshape(len(line), -1, 1) * outwards
    vertices = np.empty((len(line), len(profile), 3))
    vertices[..., :2] = line[:, None, :2] + offsets[..., :1] * left[:, None]
    vertices[..., 2] = line[:, None, 2] + offsets[..., 1]
    count = len(profile)
    i = np.arange(len(line) - 1)[:, None] * count + np.arange(count)
    j = np.arange(len(line) - 1)[:, None] * count + (np.arange(count) + 1) % count
    faces = np.concatenate([np.stack([i, j, j + count], -1), np.stack([i, j + count, i + count], -1)]).reshape(-1, 3)
    return Mesh(vertices.reshape(-1, 3), faces, np.full(len(faces), reflectance))


def beside(line: Array, every_m: float, low: Array, high: Array, jitter_m: float, rng: np.random.Generator) -> Mesh:
    """Return boxes along a line ``(N, 3)``, from corners ``low`` to ``high`` ``(3,)``: ahead, to the left, and up."""
    arc, left = frames_along(line)
    at = np.arange(every_m / 2, arc[-1], every_m)
    parts = []
    for s in at + rng.uniform(-jitter_m, jitter_m, len(at)):
        k = int(np.clip(np.searchsorted(arc, s), 0, len(arc) - 1))
        yaw = np.arctan2(-left[k, 0], left[k, 1])
        parts.append(boxes(low, high, rng.uniform(0.3, 0.6)).placed(line[k, 0], line[k, 1], line[k, 2], yaw))
    return merge(parts)
