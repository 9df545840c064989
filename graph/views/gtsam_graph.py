"""Pose graphs as GTSAM's factors and values, and back."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.errors import DataError
from hybridlio.graph.calibration.variables import insert_calibrations
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, from_integer, to_integer
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.noise import Noise
from hybridlio.graph.solve.builder import Builder

_BETWEEN = {"BetweenFactorPose3", "BetweenFactorPose2"}
_PRIOR = {"PriorFactorPose3", "PriorFactorPose2"}


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
    insert_calibrations(values, data.calibrations)
    return graph, values


def from_gtsam(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> GraphData:
    """Return a pose graph of factors over poses; inverse of :func:`to_gtsam`, but for fixed poses, which become priors.

    Between-factors and priors with Gaussian noise become this package's own; all others stay GTSAM's.

    Raises:
        DataError: values of other kinds than poses of one dimension, or a factor over other variables.
    """
    if not isinstance(graph, gtsam.NonlinearFactorGraph) or not isinstance(values, gtsam.Values):
        raise DataError(f"from_gtsam: expected a NonlinearFactorGraph and Values, got {type(graph).__name__}")
    names = list(values.keys())
    poses = [_pose(values, name) for name in names]
    if len({len(pose) for pose in poses}) != 1:
        raise DataError("from_gtsam: the values must be poses, all in the plane or all in space")
    data = GraphData(2 if len(poses[0]) == 3 else 3)
    data.add_poses([from_integer(name) for name in names], np.array(poses))
    for k in range(graph.size()):
        factor = graph.at(k)
        if factor is not None:
            data.add_factor(_factor(data, factor, k))
    return data


def _pose(values: gtsam.Values, name: int) -> Any:
    for dimension in (3, 2):
        try:
            pose = getattr(values, f"atPose{dimension}")(name)
        except RuntimeError:  # GTSAM's only answer to a value of another type
            continue
        return pose_coordinates(pose)
    raise DataError(f"from_gtsam: the value of {gtsam.Symbol(name).string()} is no pose")


def pose_coordinates(pose: Any) -> Any:
    """Return the coordinates ``(7,)`` or ``(3,)`` of GTSAM's ``Pose3`` or ``Pose2``."""
    if isinstance(pose, gtsam.Pose2):
        return np.array([pose.x(), pose.y(), pose.theta()])
    return co.from_matrices(np.asarray(pose.matrix())[None], 3)[0]


def _factor(data: GraphData, factor: Any, row: int) -> Factor:
    keys: tuple[Key, ...] = tuple(from_integer(key) for key in list(factor.keys()))
    unknown = [key for key in keys if key not in data]
    if unknown:
        raise DataError(f"from_gtsam: factor {row} concerns {unknown[0]}, which has no pose among the values")
    kind = type(factor).__name__
    model = factor.noiseModel() if hasattr(factor, "noiseModel") else None
    if kind not in _BETWEEN | _PRIOR or model is None or isinstance(model, gtsam.noiseModel.Robust):
        return Factor("gtsam", keys, np.zeros(0), code=factor)
    measured = pose_coordinates(factor.measured() if kind in _BETWEEN else factor.prior())
    information = co.our_order(model.information(), data.dimension)
    return Factor("between" if kind in _BETWEEN else "prior", keys, measured, Noise("information", information))
