"""Marginalised poses: what their factors say about the poses that stay, as one linear factor of GTSAM's."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.marginals import Marginal
from hybridlio.graph.model.measurements import CODE, Factor
from hybridlio.graph.solve.builder import Builder

# Of poses alone: the velocities, biases, landmarks and calibration of other kinds would become part of the factor.
_OF_POSES = ("between", "prior", "gps", "attitude", "altitude", "heading", "marginal", *CODE)


def marginal_factor(data: GraphData, gone: Collection[Key], coordinates: Array) -> Factor | None:
    """Return a factor of the poses that share factors with those of some keys, or None where none does.

    It is exact for the factors as linearised at the coordinates, with the weights of their kernels there.

    Args:
        data: the graph.
        gone: keys of the poses to eliminate.
        coordinates: of all poses, ``(N, 7)`` or ``(N, 3)``, at which the factors are linearised.

    Raises:
        GraphError: a factor of theirs is of another kind than of poses alone, or does not determine them.
    """
    builder, leaving = Builder(data), {data.index[key] for key in gone}
    near = np.isin(data.edges.ends, list(leaving)).any(axis=1)
    graph = gtsam.NonlinearFactorGraph()
    for row in np.flatnonzero(near).tolist():
        graph.push_back(builder.edges(slice(row, row + 1))[0])
    for factor in data.other_factors.values():
        if not leaving.isdisjoint(data.index[key] for key in factor.keys):
            _check_kind(factor)
            graph.push_back(builder.factor(factor))
    for key in data.fixed & set(gone):
        graph.push_back(builder.fixed_pose_prior(key))
    concerned = sorted({gtsam.Symbol(key).index() for key in graph.keyVector()})
    staying = [index for index in concerned if index not in leaving]
    values = gtsam.Values()
    for index, pose in zip(concerned, co.gtsam_poses(coordinates[concerned]), strict=True):
        values.insert(X(index), pose)
    left = _eliminated(graph, values, [X(index) for index in concerned if index in leaving])
    if not staying or not left.size():
        return None
    linear = gtsam.JacobianFactor(left, _ordering([X(index) for index in staying]))
    kept = [gtsam.Symbol(key).index() for key in linear.keys()]  # noqa: SIM118  (GTSAM's, no mapping)
    A, b = linear.jacobian()
    return Factor("marginal", tuple(data.keys_at(kept)), Marginal(coordinates[kept], A, b).packed())


def _check_kind(factor: Factor) -> None:
    if factor.kind not in _OF_POSES or factor.calibration:
        raise GraphError(
            f"marginalise: {factor.label} concerns more than poses; only poses whose factors are of poses alone can be "
            "marginalised"
        )


def _eliminated(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaving: list[int]) -> Any:
    """Return the linear factors that remain of a graph once some variables are eliminated."""
    made: Any = graph.linearize(values)
    try:
        return made.eliminatePartialSequential(_ordering(leaving))[1]
    except RuntimeError as error:
        raise GraphError(f"marginalise: the poses cannot be eliminated: {gtsam_message(error)}") from error


def _ordering(variables: list[int]) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for variable in variables:
        ordering.push_back(variable)
    return ordering
