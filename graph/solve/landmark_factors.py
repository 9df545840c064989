"""Landmarks as GTSAM's variables ``l``, by landmark index, and observations of them as GTSAM's factors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from hybridlio.core.arrays import Array
from hybridlio.graph.base.noise import with_kernel
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.landmark_places import place
from hybridlio.graph.model.measurements import OBSERVATIONS, PARTIAL_OBSERVATIONS, Factor


def observation(data: GraphData, factor: Factor, robust: bool) -> Any:
    """Return a landmark's bearing and range from a pose.

    GTSAM's wrapper has no factor of a point in the frame of a pose that can be saved, so its covariance is propagated
    to bearing and range at the measured point: Σ' = J Σ Jᵀ.
    """
    assert factor.noise is not None
    assert factor.landmark is not None
    if factor.kind in PARTIAL_OBSERVATIONS:
        return _partial_observation(data, factor, robust)
    variables = X(data.index[factor.keys[0]]), L(data.landmarks.index[factor.landmark])
    if factor.kind == "bearing-range":
        bearing, distance = factor.measured[:-1], float(factor.measured[-1])
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(factor.noise.information)
    else:
        bearing, distance = _bearing(factor.measured), float(np.linalg.norm(factor.measured))
        J = _polar_jacobian(factor.measured)
        model = gtsam.noiseModel.Gaussian.Covariance(J @ factor.noise.covariance @ J.T)
    if robust and factor.robust is not None:
        model = with_kernel(model, factor.robust.kernel, factor.robust.width)
    if data.dimension == 2:
        return gtsam.BearingRangeFactor2D(*variables, gtsam.Rot2(float(bearing[0])), distance, model)
    return gtsam.BearingRangeFactor3D(*variables, gtsam.Unit3(bearing), distance, model)


def _partial_observation(data: GraphData, factor: Factor, robust: bool) -> Any:
    """Return a landmark's bearing or range alone."""
    assert factor.noise is not None
    assert factor.landmark is not None
    variables = X(data.index[factor.keys[0]]), L(data.landmarks.index[factor.landmark])
    model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(factor.noise.information)
    if robust and factor.robust is not None:
        model = with_kernel(model, factor.robust.kernel, factor.robust.width)
    if factor.kind == "range":
        make = gtsam.RangeFactor2D if data.dimension == 2 else gtsam.RangeFactor3D
        return make(*variables, float(factor.measured[0]), model)
    if data.dimension == 2:
        return gtsam.BearingFactor2D(*variables, gtsam.Rot2(float(factor.measured[0])), model)
    return gtsam.BearingFactor3D(*variables, gtsam.Unit3(factor.measured), model)


def _bearing(point: Array) -> Array:
    return point if len(point) == 3 else np.array([np.arctan2(point[1], point[0])])


def _polar_jacobian(point: Array) -> Array:
    """Return the derivative ``(d, d)`` of bearing, in GTSAM's basis of the direction, and range by the point."""
    distance = np.linalg.norm(point)
    direction = point / distance
    basis = gtsam.Unit3(point).basis() if len(point) == 3 else np.array([[-direction[1]], [direction[0]]])
    return np.vstack([basis.T / distance, direction])


def point_in_pose_frame(factor: Factor) -> Array:
    """Return the observed landmark ``(d,)`` in the frame of the pose."""
    z = factor.measured
    if factor.kind == "point":
        return z
    if len(z) == 4:
        return np.asarray(z[3] * z[:3])
    return np.asarray(z[1] * np.array([np.cos(z[0]), np.sin(z[0])]))


def initial_landmarks(data: GraphData, poses: Array) -> dict[int, Array]:
    """Return a point ``(d,)`` for each observed landmark, by index, at coordinates ``(N, 7)`` or ``(N, 3)`` of poses.

    It is the given one where the poses are the given ones, else the median of what the observations say, which a few
    wrong ones do not move far. One that ranges and bearings alone observe starts as given, or where they place it.

    Raises:
        GraphError: ranges and bearings allow several places of a landmark, and none is given.
    """
    if not len(data.landmarks):
        return {}
    d, T = data.dimension, co.to_matrices(poses)
    seen: dict[int, list[Array]] = {}
    for factor in data.other_factors.values():
        if factor.kind in OBSERVATIONS and factor.landmark is not None:
            pose = T[data.index[factor.keys[0]]]
            points = seen.setdefault(data.landmarks.index[factor.landmark], [])
            points.append(pose[:d, :d] @ point_in_pose_frame(factor) + pose[:d, 3])
    found: dict[int, Array] = {k: np.median(points, axis=0) for k, points in seen.items()}
    given = data.landmarks.initial_values
    for key, factors in _partly_observed(data).items():
        k = data.landmarks.index[key]
        if k not in found:
            at = T[[data.index[factor.keys[0]] for factor in factors]]
            found[k] = place(key, factors, at, d) if np.isnan(given[k, 0]) else given[k]
    if np.array_equal(poses, data.initial_values):
        found |= {k: given[k] for k in found if not np.isnan(given[k, 0])}
    return found


def _partly_observed(data: GraphData) -> dict[Key, list[Factor]]:
    """Return the ranges and bearings of each landmark that has any."""
    found: dict[Key, list[Factor]] = {}
    for factor in data.other_factors.values():
        if factor.kind in PARTIAL_OBSERVATIONS and factor.landmark is not None:
            found.setdefault(factor.landmark, []).append(factor)
    return found


def insert_landmarks(values: gtsam.Values, points: Mapping[int, Array]) -> None:
    """Insert landmarks by index into GTSAM's values."""
    for k, point in points.items():
        values.insert(L(k), point)


def landmark_point(source: Any, index: int, dimension: int, method: str = "at") -> Array:
    """Return a landmark ``(d,)`` from GTSAM's values, or from a solver by ``method="calculateEstimate"``."""
    return np.array(getattr(source, f"{method}Point{dimension}")(L(index)))
