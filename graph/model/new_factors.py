"""Factors from what a user gives: keys, poses, vectors, noise and samples are checked here, and only here."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.se3 import as_floats
from hybridlio.core.sensors import NOISE_DENSITIES, ImuNoise, ImuSamples
from hybridlio.graph.base.preintegration import MOST_TURN_RAD
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationNames, chosen, of_kind
from hybridlio.graph.model.graph_data import GraphData, PosesByKey
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import (
    CODE,
    PARTIAL_OBSERVATIONS,
    SCALARS,
    STEPS,
    VECTOR_NOISE_SIZE,
    Factor,
    Kind,
    factor_label,
)
from hybridlio.graph.model.noise import NoiseInput, RobustLike, make_noise, make_robust


def prior_factor(data: GraphData, key: Key, pose: ArrayLike, noise: NoiseInput, robust: RobustLike) -> Factor:
    """Return a measurement of a pose in world; the graph need not have the pose.

    Raises:
        DataError: not a pose, or the noise is not symmetric positive definite.
        GraphError: malformed key, or none or several forms of noise.
    """
    key = check_key(key)
    return _pose_factor(data, "prior", (key,), pose, noise, robust)


def between_factor(
    data: GraphData, ends: tuple[Key, Key], T_i_j: ArrayLike, noise: NoiseInput, robust: RobustLike
) -> Factor:
    """Return a measurement of pose j in the frame of pose i; the graph need not have pose j.

    Raises:
        DataError: not a pose, or the noise is not symmetric positive definite.
        GraphError: unknown pose i, malformed key, a pose joined to itself, or none or several forms of noise.
    """
    name = factor_label("between", ends)
    (i,) = data.known_keys(ends[0], what=name)
    j = check_key(ends[1])
    _require_two_poses(i, j, name)
    return _pose_factor(data, "between", (i, j), T_i_j, noise, robust)


def _pose_factor(
    data: GraphData, kind: Kind, keys: tuple[Key, ...], pose: ArrayLike, noise: NoiseInput, robust: RobustLike
) -> Factor:
    name, size = factor_label(kind, keys), data.tangent_size
    measured = co.from_matrix(pose, data.dimension, name)
    return Factor(kind, keys, measured, make_noise(name, size, noise), make_robust(robust, size, name))


def vector_factor(
    data: GraphData, kind: Kind, key: Key, vectors: tuple[ArrayLike, ...], noise: NoiseInput, robust: RobustLike = None
) -> Factor:
    """Return a factor of one pose that measures vectors or a number.

    Args:
        data: the graph.
        kind: one of :data:`VECTOR_NOISE_SIZE`.
        key: of the pose.
        vectors: what is measured, ``(3,)`` each, or ``(1,)``, in the order of :class:`Factor`'s ``measured``.
        noise: of the measurement.
        robust: kernel.

    Raises:
        DataError: a vector is malformed, or the noise is not symmetric positive definite.
        GraphError: unknown pose, a planar graph, or none or several forms of noise.
    """
    name, size = factor_label(kind, (key,)), VECTOR_NOISE_SIZE[kind]
    (key,) = data.known_keys(key, what=name)
    if kind != "heading":
        data.require_space(name)
    measured = np.concatenate([check_vector(vector, 1 if kind in SCALARS else 3, name) for vector in vectors])
    return Factor(kind, (key,), measured, make_noise(name, size, noise), make_robust(robust, size, name))


def gps_factor(
    data: GraphData, key: Key, vectors: tuple[ArrayLike, ArrayLike | None], noise: NoiseInput, robust: RobustLike,
    calibration: CalibrationNames,
) -> Factor:  # fmt: skip
    """Return the measured position of an antenna; in the plane the vectors get z = 0.

    Args:
        data: the graph.
        key: of the pose.
        vectors: position in world, and antenna in the body frame or None.
        noise: of the position.
        robust: kernel.
        calibration: names of calibration variables.

    Raises:
        DataError: a vector is malformed, or the noise is not symmetric positive definite.
        GraphError: unknown pose or variable, a variable of another kind, a lever arm given twice, or none or several
            forms of noise.
    """
    name, d = factor_label("gps", (key,)), data.dimension
    (key,) = data.known_keys(key, what=name)
    names = chosen(data.calibrations, calibration, ("lever_arm", "time_offset"), name)
    if vectors[1] is not None and of_kind(data.calibrations, names, "lever_arm") is not None:
        raise GraphError(f"{name}: give lever_arm_m or a calibration variable, not both")
    given = (np.zeros(d) if vector is None else check_vector(vector, d, name) for vector in vectors)
    measured = np.concatenate([np.r_[vector, np.zeros(3 - d)] for vector in given])
    made = make_noise(name, d, noise), make_robust(robust, d, name)
    return Factor("gps", (key,), measured, *made, calibration=names)


def imu_factor(
    data: GraphData, ends: tuple[Key, Key], samples: ImuSamples, noise: ImuNoise, calibration: CalibrationNames = ()
) -> Factor:  # fmt: skip
    """Return an inertial factor between two poses.

    Raises:
        DataError: fewer than two samples, a turn of more than half a turn between them, or noise densities that are not
            positive.
        GraphError: unknown pose or calibration variable, a pose joined to itself, or a planar graph.
    """
    name = factor_label("imu", ends)
    i, j = data.known_keys(*ends, what=name)
    data.require_space(name)
    _require_two_poses(i, j, name)
    if not isinstance(samples, ImuSamples) or not isinstance(noise, ImuNoise):
        given = type(noise if isinstance(samples, ImuSamples) else samples).__name__
        raise DataError(f"{name}: expected ImuSamples and ImuNoise, got {given}")
    if len(samples) < 2:
        raise DataError(f"{name}: at least 2 IMU samples are needed, got {len(samples)}")
    if (turn := samples.largest_turn_rad(np.zeros(3))) > MOST_TURN_RAD:
        raise DataError(
            f"{name}: the samples turn by {np.degrees(turn):.0f}°, and one factor describes 180° at most; add poses in "
            "between"
        )
    densities = np.array(astuple(noise))
    if not (np.isfinite(densities).all() and min(getattr(noise, field) for field in NOISE_DENSITIES) > 0):
        raise DataError(f"{name}: noise densities must be finite and positive, got {densities.tolist()}")
    names = chosen(data.calibrations, calibration, ("bias", "gravity"), name)
    return Factor("imu", (i, j), densities, samples=samples, calibration=names)


def observation_factor(
    data: GraphData, kind: Kind, ends: tuple[Key, Key], measured: tuple[ArrayLike, ...], noise: NoiseInput,
    robust: RobustLike,
) -> Factor:  # fmt: skip
    """Return an observation of a landmark from a pose; the graph need not have the landmark.

    Args:
        data: the graph.
        kind: of an observation.
        ends: keys of pose and landmark.
        measured: the point; or bearing, range or both.
        noise: of the measurement; two sigmas of a bearing and a range in space become three.
        robust: kernel.

    Raises:
        DataError: malformed numbers, a point at the pose itself, or the noise is not symmetric positive definite.
        GraphError: unknown pose, malformed key, a pose as landmark, or none or several forms of noise.
    """
    name, d = factor_label(kind, ends), data.dimension
    size: int = d
    (pose,) = data.known_keys(ends[0], what=name)
    landmark = check_key(ends[1])
    if landmark in data:
        raise GraphError(f"{name}: {landmark} is a pose, not a landmark")
    if kind == "point":
        z = check_vector(measured[0], d, name)
        if not z.any():
            raise DataError(f"{name}: the point lies at the pose itself, so that it has no bearing")
    elif kind in PARTIAL_OBSERVATIONS:
        z, size = _partial(kind, measured[0], d, name), 1 if kind == "range" else d - 1
    else:
        z = _bearing_range(measured, d, name)
        if noise.sigmas is not None and d == 3 and (sigmas := as_floats(noise.sigmas, name)).shape == (2,):
            bearing, distance = sigmas
            noise = NoiseInput(sigmas=[bearing, bearing, distance])
    return Factor(kind, (pose,), z, make_noise(name, size, noise), make_robust(robust, size, name), landmark=landmark)


def _bearing_range(measured: tuple[ArrayLike, ...], dimension: int, name: str) -> Array:
    kinds = ("bearing", "range")
    return np.concatenate([_partial(kind, one, dimension, name) for kind, one in zip(kinds, measured, strict=True)])


def _partial(kind: str, measured: ArrayLike, dimension: int, name: str) -> Array:
    """Return a range ``(1,)`` or a bearing, the angle ``(1,)`` in the plane and a unit direction ``(3,)`` in space."""
    values = np.atleast_1d(as_floats(measured, name))
    if kind == "range":
        distance = check_vector(values, 1, name)
        if distance[0] <= 0:
            raise DataError(f"{name}: the range must be positive, got {distance[0]}")
        return distance
    bearing = check_vector(values, 1 if dimension == 2 else 3, name)
    if dimension == 3:
        check_direction(bearing, name)
        bearing = bearing / np.linalg.norm(bearing)
    return bearing


def new_measurement(factor: Factor, measured: ArrayLike, dimension: co.Dimension) -> Array:
    """Return another measurement of a factor, as :class:`Factor` holds it.

    Raises:
        GraphError: a factor of samples, a marginal, a user's code or GTSAM's.
        DataError: a measurement of another shape, or not finite.
    """
    name, old = factor.label, factor.measured
    if factor.kind in ("imu", "marginal", *CODE):
        raise GraphError(
            f"{name}: samples, marginals and code are no measurement to replace; remove it and add another"
        )
    if factor.kind in (*STEPS, "prior"):
        return co.from_matrix(measured, dimension, name)
    if factor.kind == "gps":
        return np.concatenate([check_vector(measured, dimension, name), np.zeros(3 - dimension), old[3:]])
    if factor.kind == "attitude":
        check_direction(measured, name)
        return np.concatenate([old[:3], check_vector(measured, 3, name)])
    if factor.kind == "bearing-range":
        if not isinstance(measured, tuple | list) or len(measured) != 2:
            raise DataError(f"{name}: expected bearing and range, got {measured!r}")
        return _bearing_range((measured[0], measured[1]), dimension, name)
    if factor.kind in PARTIAL_OBSERVATIONS:
        return _partial(factor.kind, measured, dimension, name)
    values = check_vector(np.atleast_1d(as_floats(measured, name)), len(old), name)
    if factor.kind == "point" and not values.any():
        raise DataError(f"{name}: the point lies at the pose itself, so that it has no bearing")
    return values


def check_start(data: GraphData, poses: PosesByKey) -> PosesByKey:
    """Return poses that a graph can start from, such as a solution.

    Raises:
        DataError: something that holds no poses, or those of a graph of the other dimension.
    """
    coordinates = getattr(poses, "coordinates", None)
    if not hasattr(poses, "keys") or not isinstance(coordinates, np.ndarray):
        raise DataError(f"start values: expected a solution, got {type(poses).__name__}")
    if coordinates.shape[1:] != co.IDENTITY[data.dimension].shape:
        raise DataError(f"start values: the graph is {data.dimension}D, but the solution is of the other dimension")
    return poses


def check_direction(direction: ArrayLike, name: str) -> None:
    """Raise DataError where a vector is zero, and so has no direction."""
    if not as_floats(direction, name).any():
        raise DataError(f"{name}: a direction must not be zero")


def check_vector(values: ArrayLike, size: int, name: str) -> Array:
    """Return the values as float64 ``(size,)``.

    Raises:
        DataError: wrong shape or not finite.
    """
    array = as_floats(values, name).copy()
    if array.shape != (size,) or not np.isfinite(array).all():
        raise DataError(f"{name}: expected {size} finite numbers, got {array.tolist()}")
    return array


def _require_two_poses(i: Key, j: Key, name: str) -> None:
    if i == j:
        raise GraphError(f"{name}: joins pose {i} to itself")
