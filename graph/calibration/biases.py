"""Biases of inertial sensors: where preintegration starts, and turn rates without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B

from hybridlio.core.arrays import Array
from hybridlio.graph.calibration.variables import variable_of
from hybridlio.graph.model.calibrations import of_kind
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.measurements import Factor

BiasAt: TypeAlias = Callable[[int], gtsam.imuBias.ConstantBias]  # by GTSAM's variable


def bias_variable(data: GraphData, factor: Factor) -> int:
    """Return the variable of the biases at the start of an inertial factor."""
    constant = of_kind(data.calibrations, factor.calibration, "bias")
    return int(B(data.index[factor.keys[0]])) if constant is None else variable_of(data.calibrations, constant.name)


def measured_biases(data: GraphData) -> BiasAt:
    """Return biases by variable: those of bias factors, constant ones as stated, else zero."""
    others = data.other_factors.values()
    measured = {int(B(data.index[factor.keys[0]])): factor.measured for factor in others if factor.kind == "bias"}
    constant = ((name, one) for name, one in data.calibrations.items() if one.kind == "bias")
    measured |= {variable_of(data.calibrations, name): one.stated for name, one in constant}
    zero = np.zeros(6)

    def bias_at(variable: int) -> gtsam.imuBias.ConstantBias:
        bias = measured.get(variable, zero)
        return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])

    return bias_at


def turn_rates(data: GraphData, bias_at: BiasAt) -> dict[int, Array]:
    """Return turn rates ``(3,)`` in rad/s, without bias, at the poses where inertial samples begin or end, by index."""
    found: dict[int, Array] = {}
    for factor in data.other_factors.values():
        if factor.samples is not None:
            bias = bias_at(bias_variable(data, factor)).gyroscope()
            for key, row in zip(factor.keys, (0, -1), strict=True):
                found[data.index[key]] = factor.samples.gyro_rad_s[row] - bias
    return found
