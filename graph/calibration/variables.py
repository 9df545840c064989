"""Calibration variables as GTSAM's variables ``c``, by their order in the graph, with their priors.

A variable is a vector, biases are GTSAM's, and gravity is a ``Unit3``. Extrinsics ``K`` are ``K = stated·Exp(c)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

from hybridlio.graph.model.calibrations import CalibrationVariable

Variables: TypeAlias = Mapping[str, CalibrationVariable]  # of a graph, by name


def variable_of(variables: Variables, name: str) -> int:
    """Return GTSAM's variable of a calibration variable."""
    return int(C(list(variables).index(name)))


def stated_value(variable: CalibrationVariable) -> Any:
    """Return the stated value in the form that GTSAM's values hold."""
    if variable.kind == "bias":
        return gtsam.imuBias.ConstantBias(variable.stated[:3], variable.stated[3:])
    if variable.kind == "gravity":
        return gtsam.Unit3(variable.stated)
    if variable.kind == "extrinsics":
        return np.zeros(len(variable.noise.values))
    return variable.stated


def insert_calibrations(values: gtsam.Values, variables: Variables) -> None:
    """Insert all calibration variables at their stated values."""
    for name, variable in variables.items():
        values.insert(variable_of(variables, name), stated_value(variable))


def prior(variables: Variables, name: str) -> Any:
    """Return the prior of a calibration variable."""
    variable, key = variables[name], variable_of(variables, name)
    at, model = stated_value(variable), gtsam.noiseModel.Gaussian.Covariance(variable.noise.covariance)
    if variable.kind == "bias":
        return gtsam.PriorFactorConstantBias(key, at, model)
    if variable.kind == "gravity":
        return gtsam.PriorFactorUnit3(key, at, model)
    make = {2: gtsam.PriorFactorPoint2, 3: gtsam.PriorFactorPoint3}.get(len(at), gtsam.PriorFactorVector)
    return make(key, at, model)
