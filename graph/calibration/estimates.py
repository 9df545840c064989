"""Estimates of calibration variables, and in which directions the measurements determine them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError, shown
from hybridlio.graph.calibration.factors import extrinsics_matrix
from hybridlio.graph.calibration.variables import variable_of
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationKind, CalibrationVariable
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.smoothing.calibration import Estimated, undetermined_directions

_POSE = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")
_COMPONENTS = {
    "lever_arm": ("x", "y", "z"),
    "extrinsics": _POSE,
    "bias": ("accelerometer x", "accelerometer y", "accelerometer z", "gyroscope x", "gyroscope y", "gyroscope z"),
    "gravity": ("the first tilt", "the second tilt"),
}
_NAMED_SHARE = 0.3  # of a unit vector: of six equal components, each has 0.4; smaller shares only confuse


@dataclass(frozen=True, eq=False)
class CalibrationEstimate(Estimated):
    """A solved calibration variable.

    Attributes:
        name, kind: of the variable.
        value: ``lever_arm`` ``(3,)`` or ``(2,)`` m; ``extrinsics`` ``(4, 4)``; ``time_offset`` in s and ``scale``, one
            number each; ``bias`` accelerometer, gyroscope ``(6,)``; ``gravity`` its direction in world ``(3,)``.
        change: against what was stated; of extrinsics a right perturbation, rotation first, of ``gravity`` two tilts in
            rad.
        covariance: of ``change``; of ``gravity`` ``(3, 3)`` of the direction in world, of rank two.
        undetermined: ``(u, d)`` unit vectors, in units of the prior's standard deviations, of the directions in which
            the measurements hardly add to the prior: there it stays as stated.
    """

    name: str
    kind: CalibrationKind
    value: Any
    change: Array
    covariance: Array
    undetermined: Array

    @property
    def doubt(self) -> str | None:
        """What the measurements do not determine, or None."""
        if self.is_determined:
            return None
        if len(self.undetermined) == self.undetermined.shape[1]:
            return f"{self.name}: the measurements do not determine it; it stays as stated"
        names = _POSE[2:5] if self.undetermined.shape[1] == 3 and self.kind == "extrinsics" else _COMPONENTS[self.kind]
        shares = np.abs(self.undetermined).max(axis=0).tolist()
        free = [name for name, share in zip(names, shares, strict=False) if share > _NAMED_SHARE]
        return f"{self.name}: the measurements do not determine {', '.join(free)}; there it stays as stated"

    def __str__(self) -> str:
        value = self.change if self.kind == "extrinsics" else np.atleast_1d(self.value)
        what = "changed by " if self.kind == "extrinsics" else ""
        numbers = ", ".join(f"{a:.4g} ± {b:.2g}" for a, b in zip(value, self.sigmas, strict=True))
        return f"{self.name} ({self.kind}): {what}{numbers}"


def estimate(data: GraphData, values: gtsam.Values, name: str, marginal: Array) -> CalibrationEstimate:
    """Return a solved variable.

    Args:
        data: the graph.
        values: GTSAM's solution.
        name: of the variable.
        marginal: GTSAM's marginal covariance of it.
    """
    variable, (key, to_reported) = data.calibrations[name], reported(data, values, name)
    value, change = _value(variable, values, key)
    whitener = np.linalg.inv(np.linalg.cholesky(variable.noise.covariance))
    undetermined = undetermined_directions(whitener @ marginal @ whitener.T, 1.0)
    covariance = to_reported @ marginal @ to_reported.T
    return CalibrationEstimate(name, variable.kind, value, change, (covariance + covariance.T) / 2, undetermined)


def _value(variable: CalibrationVariable, values: gtsam.Values, key: int) -> tuple[Any, Array]:
    """Return value and change of a variable."""
    if variable.kind == "bias":
        found: Array = values.atConstantBias(key).vector()
    elif variable.kind == "gravity":
        direction = values.atUnit3(key)
        return direction.point3(), gtsam.Unit3(variable.stated).localCoordinates(direction)
    else:
        found = values.atVector(key)
    if variable.kind == "extrinsics":
        return extrinsics_matrix(variable) @ se3.exp(_in_space(found)), found
    return (float(found[0]) if len(found) == 1 else found), found - variable.stated


def _in_space(change: Array) -> Array:
    """Return a tangent vector of six from heading, x and y, or itself."""
    return change if len(change) == 6 else np.r_[0.0, 0.0, change, 0.0]


def reported(data: GraphData, values: gtsam.Values, key: Key | str) -> tuple[int, Array]:
    """Return GTSAM's variable of a pose, landmark or calibration, and what its covariance is reported by, ``M·Σ·Mᵀ``.

    Raises:
        GraphError: the graph has none of this name or key.
    """
    if isinstance(key, str):
        if key not in data.calibrations:
            raise GraphError(f"there is no calibration variable {shown(key)}")
        return _reported_calibration(data.calibrations[key], values, variable_of(data.calibrations, key))
    known = check_key(key)
    if known in data.landmarks:
        return int(L(data.landmarks.index[known])), np.eye(data.dimension)
    if known not in data:
        raise GraphError(f"no pose has key {known}")
    order = np.argsort(co.GTSAM_ORDER[data.dimension])
    return int(X(data.index[known])), np.eye(len(order))[order]


def _reported_calibration(variable: CalibrationVariable, values: gtsam.Values, key: int) -> tuple[int, Array]:
    if variable.kind == "gravity":
        return key, np.asarray(values.atUnit3(key).basis())
    if variable.kind != "extrinsics":
        return key, np.eye(len(variable.stated))
    change = values.atVector(key)
    own = slice(0, 6) if len(change) == 6 else slice(2, 5)
    return key, np.asarray(gtsam.Pose3.ExpmapDerivative(_in_space(change))[own, own])
