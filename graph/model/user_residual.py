"""Residuals that users write in Python, with derivatives that are given or taken numerically."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.se3 import as_floats
from hybridlio.graph.model import coordinates as co

Residual: TypeAlias = Callable[..., Any]  # of poses (4, 4), one argument a key: (m,)
Jacobian: TypeAlias = Callable[..., Any]  # of the same: one (m, d) a key, by right perturbations, rotation first

# rad, m: central differences of functions of size one are then exact to 1e-10, half of the digits of a double each for
# rounding and for the third derivative.
_STEP = 1e-5
_AGREEMENT = 1e-4  # relative difference of given and numeric derivatives: far above 1e-10, far below a wrong sign


@dataclass(frozen=True, eq=False)
class UserResidual:
    """A function of poses.

    Attributes:
        name: of the factor, for error messages.
        size: m, length of the residual.
        dimension: of the graph.
        call: the function.
        jacobian: its derivatives, or None: then they are taken by central differences.
    """

    name: str
    size: int
    dimension: co.Dimension
    call: Residual
    jacobian: Jacobian | None = None

    def __call__(self, poses: Sequence[Array]) -> Array:
        """Return the residual ``(m,)`` at poses ``(4, 4)``.

        Raises:
            DataError: the function returns another size, or values that are not finite.
        """
        values = np.atleast_1d(as_floats(self.call(*poses), f"{self.name}: residual"))
        if values.shape != (self.size,) or not np.isfinite(values).all():
            raise DataError(f"{self.name}: the residual must be {self.size} finite numbers, got {values.tolist()}")
        return values

    def derivatives(self, poses: Sequence[Array]) -> list[Array]:
        """Return the derivative ``(m, d)`` by a right perturbation of each pose.

        Raises:
            DataError: the given function returns another number or shape of matrices.
        """
        if self.jacobian is None:
            return self.numeric_derivatives(poses)
        given = self.jacobian(*poses)
        given = given if isinstance(given, list | tuple) else [given]
        matrices = [as_floats(J, f"{self.name}: Jacobian") for J in given]
        shape = self.size, co.TANGENT_SIZE[self.dimension]
        if len(matrices) != len(poses) or any(J.shape != shape for J in matrices):
            shapes = ", ".join(str(J.shape) for J in matrices)
            raise DataError(f"{self.name}: the Jacobian must be {len(poses)} matrices {shape}, got {shapes}")
        return matrices

    def numeric_derivatives(self, poses: Sequence[Array]) -> list[Array]:
        """Return the derivatives by central differences: two calls for each component of each pose."""
        found = []
        for k, pose in enumerate(poses):
            columns = []
            for component in np.eye(6)[slice(0, 6) if self.dimension == 3 else slice(2, 5)]:
                ahead, behind = (
                    self([*poses[:k], pose @ se3.exp(sign * _STEP * component), *poses[k + 1 :]]) for sign in (1, -1)
                )
                columns.append((ahead - behind) / (2 * _STEP))
            found.append(np.column_stack(columns))
        return found

    def check(self, poses: Sequence[Array]) -> None:
        """Check size and derivatives once, at some poses.

        Raises:
            DataError: the sizes are wrong, or the given derivatives differ from numeric ones.
        """
        self(poses)
        if self.jacobian is None:
            return
        for k, (given, numeric) in enumerate(
            zip(self.derivatives(poses), self.numeric_derivatives(poses), strict=True)
        ):
            difference = float(np.abs(given - numeric).max())
            if difference > _AGREEMENT * max(1.0, float(np.abs(numeric).max())):
                raise DataError(
                    f"{self.name}: the Jacobian by pose {k} differs from numeric derivatives by {difference:.3g}; it "
                    "is by right perturbations T·Exp(ξ), rotation first"
                )


def altitude(altitude_m: float, name: str) -> UserResidual:
    """Return the residual of a height of the body above world's origin."""
    return UserResidual(
        name, 1, 3, lambda T: T[2:3, 3] - altitude_m, lambda T: np.hstack([np.zeros((1, 3)), T[2:3, :3]])
    )  # fmt: skip


def heading(heading_rad: float, name: str, dimension: co.Dimension) -> UserResidual:
    """Return the residual of the angle from world's x axis to the body's, seen from above."""

    def residual(T: Array) -> float:
        angle = np.arctan2(T[1, 0], T[0, 0]) - heading_rad
        return float(np.arctan2(np.sin(angle), np.cos(angle)))

    def jacobian(T: Array) -> Array:
        if dimension == 2:
            return np.array([[1.0, 0.0, 0.0]])
        (x, y), by_y, by_z = T[:2, 0], -T[:2, 2], T[:2, 1]  # the body's x axis, and how it turns about y and z
        turn = [0.0, *((x * d[1] - y * d[0]) / (x**2 + y**2) for d in (by_y, by_z))]
        return np.array([[*turn, 0.0, 0.0, 0.0]])

    return UserResidual(name, 1, dimension, residual, jacobian)


def sample_poses(initial: Sequence[Array | None], dimension: co.Dimension) -> list[Array]:
    """Return the poses ``(4, 4)`` of initial values, or ones of no special place for None, to check a function at."""
    rng, used = np.random.default_rng(0), slice(0, 6) if dimension == 3 else slice(2, 5)
    found = []
    for at in initial:
        xi = np.zeros(6)
        xi[used] = rng.uniform(-0.5, 0.5, 6)[used]
        found.append(se3.exp(xi) if at is None else np.asarray(co.to_matrices(at[None])[0]))
    return found
