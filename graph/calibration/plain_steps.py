"""Steps of sensors as steps of the body, with the calibration as stated: where a solver starts from."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.graph.calibration.factors import extrinsics_matrix
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import of_kind
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.noise import Noise


def with_plain_steps(data: GraphData) -> GraphData:
    """Return the graph with steps of sensors as between-factors; the graph itself where it has none."""
    return plain_steps(data)[0]


def plain_steps(data: GraphData) -> tuple[GraphData, dict[int, int]]:
    """Return :func:`with_plain_steps`, and the id of the sensor's step by that of each new between-factor."""
    steps = {n: factor for n, factor in data.other_factors.items() if factor.kind == "sensor-step"}
    if not steps:
        return data, {}
    plain = data.copy(without=steps)
    return plain, {plain.add_factor(_between(data, factor)): n for n, factor in steps.items()}


def _between(data: GraphData, factor: Factor) -> Factor:
    assert factor.noise is not None
    step, K = body_step(data, factor), extrinsics_matrix(of_kind(data.calibrations, factor.calibration, "extrinsics"))
    to_body = co.adjoint(K, data.dimension)
    covariance = to_body @ factor.noise.covariance @ to_body.T
    noise = Noise("covariance", np.asarray((covariance + covariance.T) / 2))
    return Factor("between", factor.keys, co.from_matrices(step[None], data.dimension)[0], noise, factor.robust)


def body_step(data: GraphData, factor: Factor) -> Array:
    """Return the step ``(4, 4)`` of the body that a sensor's measurement means with the calibration as stated."""
    step = co.to_matrices(factor.measured[None])[0]
    K = extrinsics_matrix(of_kind(data.calibrations, factor.calibration, "extrinsics"))
    scale = of_kind(data.calibrations, factor.calibration, "scale")
    if scale is not None:
        step = se3.make(step[:3, :3], step[:3, 3] / scale.stated[0])
    return np.asarray(K @ step @ se3.inverse(K))
