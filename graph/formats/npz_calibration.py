"""Calibration variables of a pose graph as arrays, for its ``.npz`` file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.graph.model.calibrations import calibration_variable
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.noise import NoiseInput

_PREFIX = "variable"


def calibration_arrays(data: GraphData) -> dict[str, Any]:
    """Return the arrays: names, kinds and forms of noise, and of each variable its stated value and noise."""
    variables = list(data.calibrations.values())
    arrays: dict[str, Any] = {
        f"{_PREFIX}_names": np.array([variable.name for variable in variables]),
        f"{_PREFIX}_kinds": np.array([variable.kind for variable in variables]),
        f"{_PREFIX}_forms": np.array([variable.noise.form for variable in variables]),
    }
    for k, variable in enumerate(variables):
        arrays |= {f"{_PREFIX}{k}_stated": variable.stated, f"{_PREFIX}{k}_noise": variable.noise.values}
    return arrays


def add_calibrations(data: GraphData, arrays: Mapping[str, Any]) -> None:
    """Add the variables of an archive to a graph.

    Raises:
        DataError: two variables of one name.
        GraphError: as for a new variable.
    """
    columns = [arrays.get(f"{_PREFIX}_{column}", np.array([])).tolist() for column in ("names", "kinds", "forms")]
    for k, (name, kind, form) in enumerate(zip(*columns, strict=True)):
        if name in data.calibrations:
            raise DataError(f"calibration variable {name!r} occurs twice")
        stated, noise = (np.array(arrays[f"{_PREFIX}{k}_{part}"]) for part in ("stated", "noise"))
        given = NoiseInput(**{form: noise})
        data.calibrations[name] = calibration_variable(name, kind, stated, given, data.dimension)
