"""Calibration of sensors as variables of a pose graph: what kinds there are, and what is stated of each before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError, shown
from hybridlio.core.se3 import as_floats
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.noise import Noise, NoiseInput, make_noise

CalibrationKind: TypeAlias = Literal["lever_arm", "extrinsics", "time_offset", "scale", "bias", "gravity"]
CALIBRATION_KINDS: tuple[CalibrationKind, ...] = get_args(CalibrationKind)
CalibrationNames: TypeAlias = "str | Sequence[str]"

_IN_SPACE = ("time_offset", "bias", "gravity")  # they need velocities or inertial samples
_SIZES: dict[str, tuple[int, int]] = {"time_offset": (1, 1), "scale": (1, 1), "bias": (6, 6), "gravity": (3, 2)}
_DEFAULTS: dict[str, Array] = {
    "time_offset": np.zeros(1), "scale": np.ones(1), "bias": np.zeros(6), "gravity": -co.UP,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CalibrationVariable:
    """A calibration variable, with its prior.

    Attributes:
        name: by which factors refer to it.
        kind: what it is.
        stated: what is known before: ``lever_arm`` ``(3,)`` m, in the plane ``(2,)``; ``extrinsics`` coordinates of
            ``T_body_sensor``; ``time_offset`` ``(1,)`` s; ``scale`` ``(1,)``; ``bias`` accelerometer, gyroscope
            ``(6,)``; ``gravity`` its direction in world, a unit vector ``(3,)``.
        noise: of that. Extrinsics have it of a right perturbation, rotation first; ``gravity`` of the two tilts, in
            GTSAM's basis of the direction.
    """

    name: str
    kind: CalibrationKind
    stated: Array
    noise: Noise


def calibration_variable(
    name: str, kind: CalibrationKind, stated: ArrayLike | None, noise: NoiseInput, dimension: co.Dimension
) -> CalibrationVariable:
    """Return a checked variable.

    Raises:
        GraphError: a name that is no text, an unknown kind, one that a planar graph cannot have, or none or several
            forms of noise.
        DataError: a stated value of another shape, or noise that is not positive definite.
    """
    if not isinstance(name, str) or not name:
        raise GraphError(f"a calibration variable needs a name, got {shown(name)}")
    if not isinstance(kind, str) or kind not in CALIBRATION_KINDS:
        raise GraphError(f"{name}: unknown kind {shown(kind)}; choose one of {', '.join(CALIBRATION_KINDS)}")
    if dimension == 2 and kind in _IN_SPACE:
        raise GraphError(f"{name}: {kind} needs a graph in space, PoseGraph(dimension=3); this one is planar")
    size = _sizes(kind, dimension)[1]
    if kind == "gravity" and noise.sigmas is not None and (sigma := as_floats(noise.sigmas, name)).ndim == 0:
        noise = noise._replace(sigmas=[float(sigma)] * 2)
    return CalibrationVariable(name, kind, _stated(name, kind, stated, dimension), make_noise(name, size, noise))


def _sizes(kind: str, dimension: int) -> tuple[int, int]:
    """Return the numbers that a value has, and its degrees of freedom."""
    if kind == "lever_arm":
        return dimension, dimension
    if kind == "extrinsics":
        return len(co.IDENTITY[dimension]), co.TANGENT_SIZE[dimension]
    return _SIZES[kind]


def _stated(name: str, kind: str, stated: ArrayLike | None, dimension: co.Dimension) -> Array:
    size = _sizes(kind, dimension)[0]
    if kind == "extrinsics":
        return co.IDENTITY[dimension].copy() if stated is None else co.from_matrix(stated, dimension, name)
    if stated is None:
        return _DEFAULTS.get(kind, np.zeros(size)).copy()
    values = np.atleast_1d(as_floats(stated, name)).copy()
    if values.shape != (size,) or not np.isfinite(values).all():
        raise DataError(f"{name}: {kind} is {size} finite numbers, got {values.tolist()}")
    if kind == "gravity":
        if not values.any():
            raise DataError(f"{name}: a direction must not be zero")
        return np.asarray(values / np.linalg.norm(values))
    if kind == "scale" and values[0] <= 0:
        raise DataError(f"{name}: a scale must be positive, got {values[0]}")
    return values


def chosen(
    variables: Mapping[str, CalibrationVariable], names: CalibrationNames, allowed: Sequence[str], factor: str
) -> tuple[str, ...]:
    """Return the names of the variables that calibrate a factor.

    Args:
        variables: of the graph.
        names: one or several.
        allowed: kinds that such a factor takes, one variable of each.
        factor: start of the messages.

    Raises:
        GraphError: an unknown name, a kind that the factor does not take, or two of a kind.
    """
    listed = [names] if isinstance(names, str) else list(names) if isinstance(names, Sequence) else [names]
    for name in listed:
        if not isinstance(name, str) or name not in variables:
            raise GraphError(f"{factor}: there is no calibration variable {shown(name)}; add it by add_calibration")
        if (kind := variables[name].kind) not in allowed:
            raise GraphError(f"{factor}: takes {', '.join(allowed)} as calibration, but {name!r} is of kind {kind}")
    kinds = [variables[name].kind for name in listed]
    if len(set(kinds)) < len(kinds):
        raise GraphError(f"{factor}: one calibration variable of each kind at most, got {', '.join(listed)}")
    return tuple(listed)


def of_kind(
    variables: Mapping[str, CalibrationVariable], names: Sequence[str], kind: CalibrationKind
) -> CalibrationVariable | None:
    """Return the variable of a kind among some names, or None."""
    return next((variables[name] for name in names if variables[name].kind == kind), None)
