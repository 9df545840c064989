"""Pose graphs as GTSAM's factors and values, and back."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.graph.calibration.variables import insert_calibrations
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, from_integer, to_integer
from hybridlio.graph.model.measurements import Factor, Kind
from hybridlio.graph.model.noise import Noise
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.landmark_factors import initial_landmarks, insert_landmarks

_BETWEEN = {"BetweenFactorPose3", "BetweenFactorPose2"}
_PRIOR = {"PriorFactorPose3", "PriorFactorPose2"}
_OBSERVATIONS: dict[str, Kind] = {
    "BearingRangeFactor3D": "bearing-range", "BearingRangeFactor2D": "bearing-range", "RangeFactor3D": "range",
    "RangeFactor2D": "range", "BearingFactor3D": "bearing", "BearingFactor2D": "bearing",
}  # fmt: skip


def to_gtsam(data: GraphData) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return all factors, priors of fixed poses and of calibration included, and the initial values that are known.

    A pose's key is its integer, or GTSAM's symbol for ``(robot, index)``. Velocities ``v``, biases ``b`` and landmarks
    ``l`` are symbols of their index, calibration variables ``c`` of their order.
    """
    names = [to_integer(key) for key in data.index]
    renamed = {X(k): name for k, name in enumerate(names)}
    graph = gtsam.NonlinearFactorGraph()
    built, in_python = Builder(data).graph(), Builder(data, pose_variable=names.__getitem__)
    ids = in_python.factor_ids()
    for k in range(built.size()):
        factor = built.at(k)
        if isinstance(factor, gtsam.CustomFactor):  # a copy by rekey is not possible
            graph.add(in_python.factor(data.other_factors[ids[k]]))
        else:
            graph.add(factor.rekey([renamed.get(key, key) for key in list(factor.keys())]))
    values, initial = gtsam.Values(), data.initial_values
    known = np.flatnonzero(~np.isnan(initial[:, 0]))
    for key, pose in zip(data.keys_at(known.tolist()), co.gtsam_poses(initial[known]), strict=True):
        values.insert(to_integer(key), pose)
    insert_landmarks(values, _landmark_points(data, initial))
    insert_calibrations(values, data.calibrations)
    return graph, values


def _landmark_points(data: GraphData, poses: Array) -> dict[int, Array]:
    """Return the initial points of landmarks by index: where their observations see them, if all poses are known."""
    given = data.landmarks.initial_values
    found = {} if np.isnan(poses).any() else initial_landmarks(data, poses)
    return found | {k: point for k, point in enumerate(given) if not np.isnan(point[0])}


def from_gtsam(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> GraphData:
    """Return a pose graph of factors over poses and landmarks; inverse of :func:`to_gtsam`.

    Fixed poses come back as priors. Between-factors, priors, and bearings and ranges of landmarks, if their noise is
    Gaussian, become this package's own; all others over poses stay GTSAM's. Calibration variables do not come back:
    GTSAM's have neither kind nor name, and their factors are code.

    Raises:
        DataError: values other than poses and points of one dimension, or a factor that cannot be taken.
    """
    if not isinstance(graph, gtsam.NonlinearFactorGraph) or not isinstance(values, gtsam.Values):
        raise DataError(f"from_gtsam: expected a NonlinearFactorGraph and Values, got {type(graph).__name__}")
    names = list(values.keys())
    poses = {name: pose for name in names if (pose := _pose(values, name)) is not None}
    if len({len(pose) for pose in poses.values()}) != 1:
        raise DataError("from_gtsam: the values must have poses, all in the plane or all in space")
    data = GraphData(2 if len(next(iter(poses.values()))) == 3 else 3)
    data.add_poses([from_integer(name) for name in poses], np.array(list(poses.values())))
    for name in names:
        if name not in poses:
            data.landmarks.add(from_integer(name), _point(values, name, data.dimension))
    for k in range(graph.size()):
        factor = graph.at(k)
        if factor is not None:
            data.add_factor(_factor(data, factor, k))
    return data


def _pose(values: gtsam.Values, name: int) -> Any:
    """Return the coordinates of a pose, or None where the value is none."""
    for dimension in (3, 2):
        try:
            pose = getattr(values, f"atPose{dimension}")(name)
        except RuntimeError:  # GTSAM's only answer to a value of another type
            continue
        return pose_coordinates(pose)
    return None


def _point(values: gtsam.Values, name: int, dimension: int) -> Array:
    try:
        return np.array(getattr(values, f"atPoint{dimension}")(name))
    except RuntimeError:
        raise DataError(
            f"from_gtsam: the value of {gtsam.Symbol(name).string()} is neither a pose nor a landmark; a pose graph "
            "takes no others from GTSAM. Its own velocities, biases and calibration are kept by .npz files"
        ) from None


def pose_coordinates(pose: Any) -> Any:
    """Return the coordinates ``(7,)`` or ``(3,)`` of GTSAM's ``Pose3`` or ``Pose2``."""
    if isinstance(pose, gtsam.Pose2):
        return np.array([pose.x(), pose.y(), pose.theta()])
    return co.from_matrices(np.asarray(pose.matrix())[None], 3)[0]


def _factor(data: GraphData, factor: Any, row: int) -> Factor:
    keys: tuple[Key, ...] = tuple(from_integer(key) for key in list(factor.keys()))
    kind = type(factor).__name__
    model = factor.noiseModel() if hasattr(factor, "noiseModel") else None
    if kind in _OBSERVATIONS and keys[1] in data.landmarks and not isinstance(model, gtsam.noiseModel.Robust):
        return _observation(data, factor, keys)
    unknown = [key for key in keys if key not in data]
    if unknown and unknown[0] in data.landmarks:
        raise DataError(
            f"from_gtsam: factor {row}, a {kind}, cannot be taken: of landmarks only bearings and ranges can, without "
            "a robust kernel"
        )
    if unknown:
        raise DataError(
            f"from_gtsam: factor {row} concerns {unknown[0]}, which has no pose among the values; add "
            "one (a graph of hybridlio's gets them by initialise(), before to_gtsam)"
        )
    if kind not in _BETWEEN | _PRIOR or model is None or isinstance(model, gtsam.noiseModel.Robust):
        return Factor("gtsam", keys, np.zeros(0), code=factor)
    measured = pose_coordinates(factor.measured() if kind in _BETWEEN else factor.prior())
    information = co.our_order(model.information(), data.dimension)
    return Factor("between" if kind in _BETWEEN else "prior", keys, measured, Noise("information", information))


def _observation(data: GraphData, factor: Any, keys: tuple[Key, ...]) -> Factor:
    kind, measured = _OBSERVATIONS[type(factor).__name__], factor.measured()
    bearing = measured.bearing() if kind == "bearing-range" else measured
    distance = [measured.range()] if kind == "bearing-range" else []
    if kind == "range":
        values = np.array([measured])
    else:
        values = np.r_[[bearing.theta()] if data.dimension == 2 else bearing.point3(), distance]
    noise = Noise("information", factor.noiseModel().information())
    return Factor(kind, keys[:1], values, noise, landmark=keys[1])
