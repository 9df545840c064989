"""Scenes with weak directions: corridors with noisy normals, open ground with bushes, trunks."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.registration.degeneracy import RegistrationProblem, register_with_degeneracy
from hybridlio.registration.results import ObservedRegistration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

SETTINGS = RegistrationSettings(threads=1)
TRUTH = se3.exp(np.array([0.002, -0.001, 0.01, 0.2, 0.1, 0.03]))
Cloud = tuple[np.ndarray, np.ndarray]


def observe(
    surface: Surface,
    source: np.ndarray,
    initial: np.ndarray,
    kernel_start_m: float = 0.0,
    *,
    vague: bool = False,
    only_scan: np.ndarray | None = None,
    dense: np.ndarray | None = None,
) -> ObservedRegistration:
    """Register with the default settings, on one thread."""
    problem = RegistrationProblem(surface, source, SETTINGS, dense, only_scan)
    return register_with_degeneracy(problem, initial, kernel_start_m, vague)


def ground(rng: np.random.Generator, count: int) -> Cloud:
    """Level ground, 60 m wide, 1.7 m below the sensor."""
    xy = rng.uniform(-30, 30, (count, 2))
    return np.column_stack([xy, np.full(count, -1.7)]), np.tile([0.0, 0.0, 1.0], (count, 1))


def bushes(rng: np.random.Generator, where: np.ndarray, points: int) -> Cloud:
    """Upright cylinders of radius 0.8 m at ``where`` ``(B, 2)``."""
    angle, height = rng.uniform(-np.pi, np.pi, (2, len(where), points))
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    centres = np.concatenate([where, np.zeros((len(where), 1))], axis=1)[:, None]
    surface = centres + 0.8 * normals + np.stack([0 * height, 0 * height, height / 3], axis=-1)
    return surface.reshape(-1, 3), normals.reshape(-1, 3)


def bend(rng: np.random.Generator, radius_m: float, count: int) -> Cloud:
    """Two walls 4 m to either side of a circle that starts ahead at the origin, and the ground between."""
    angle = rng.uniform(-25, 25, count) / radius_m
    side = rng.choice([-1.0, 0.0, 1.0], count)
    left = np.where(side == 0, rng.uniform(-4, 4, count), 4 * side)
    height = np.where(side == 0, -1.7, rng.uniform(-1.7, 2, count))
    inward = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(count)])
    points = np.array([0.0, radius_m, 0.0]) - (radius_m - left)[:, None] * inward + height[:, None] * [0, 0, 1]
    return points, np.where(side[:, None] == 0, [0.0, 0.0, 1.0], inward)


def into_a_bend(rng: np.random.Generator, count: int) -> Cloud:
    """A straight corridor, 8 m wide, whose walls and ground turn left with a radius of 10 m from 8 m ahead on."""
    start_m, radius_m = 8.0, 10.0
    along, side = rng.uniform(-20, 20, count), rng.choice([-1.0, 0.0, 1.0], count)
    left = np.where(side == 0, rng.uniform(-4, 4, count), 4 * side)
    height = np.where(side == 0, -1.7, rng.uniform(-1.7, 2, count))
    angle = np.maximum(along - start_m, 0) / radius_m
    inward = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(count)])
    middle = np.column_stack(
        [np.minimum(along, start_m) + radius_m * np.sin(angle), radius_m * (1 - np.cos(angle)), height]
    )
    return middle + left[:, None] * inward, np.where(side[:, None] == 0, [0.0, 0.0, 1.0], inward)


def joined(*clouds: Cloud) -> Cloud:
    """All points and normals of several clouds."""
    return np.concatenate([c[0] for c in clouds]), np.concatenate([c[1] for c in clouds])


def noisy_surface(rng: np.random.Generator, cloud: Cloud, by: float) -> Surface:
    """A surface with noisy normals: a tilt of ``by`` radians, eight times that for one in twenty."""
    points, normals = cloud
    lean = by * np.where(rng.random(len(points)) < 0.05, 8.0, 1.0)
    normals = normals + lean[:, None] * rng.standard_normal(points.shape)
    return Surface(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), 1)


def scan(rng: np.random.Generator, cloud: Cloud, sigma_m: float = 0.02) -> np.ndarray:
    """The cloud's points with noise, in the frame of a sensor at ``TRUTH``."""
    points = cloud[0] + sigma_m * rng.standard_normal(cloud[0].shape)
    return se3.transform(se3.inverse(TRUTH), points)


def off_by(ahead_m: float, left_m: float = 0.0) -> np.ndarray:
    """A start this far from the truth."""
    return TRUTH @ se3.exp(np.array([0.0, 0.0, 0.0, ahead_m, left_m, 0.0]))


def error(observed: ObservedRegistration) -> np.ndarray:
    """``(6,)`` tangent vector from the truth to the result."""
    return se3.log(se3.between(TRUTH, observed.registration.pose))


def in_a_field(rng: np.random.Generator, ahead_m: float, left_m: float = 0.0) -> ObservedRegistration:
    """Register a scan of open ground with twenty bushes from a start this far from the truth."""
    where = rng.uniform(-25, 25, (20, 2))
    surface = noisy_surface(rng, joined(ground(rng, 8000), bushes(rng, where, 60)), 0.03)
    source = scan(rng, joined(ground(rng, 7000), bushes(rng, where, 16)))
    return observe(surface, source, off_by(ahead_m, left_m), 0.3)


def tree_points(rng: np.random.Generator, where: np.ndarray, points: int) -> np.ndarray:
    """Points on trunks 20 cm thick and three metres high, which make no planes."""
    angle, height = rng.uniform(-np.pi, np.pi, (2, len(where), points))
    around = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([where[:, None] + around, height[..., None] / 2], axis=-1).reshape(-1, 3)


def between_trunks(rng: np.random.Generator) -> tuple[Surface, np.ndarray, np.ndarray]:
    """Ground and trunks with arbitrary normals; the points of a scan that are registered, and all its points."""
    where, (flat, upright) = rng.uniform(-25, 25, (20, 2)), ground(rng, 8000)
    trunks = tree_points(rng, where, 100)
    lean = rng.standard_normal(trunks.shape)
    normals = np.concatenate([upright, lean / np.linalg.norm(lean, axis=1, keepdims=True)])
    weights = np.concatenate([np.ones(len(flat)), np.full(len(trunks), 0.6)])
    surface = Surface(np.concatenate([flat, trunks]), normals, 1, weights)
    seen = np.concatenate([ground(rng, 7000)[0], tree_points(rng, where, 30)])
    points = scan(rng, (seen, seen), 0.01)
    return surface, np.concatenate([points[:7000], points[7000::2]]), points
