"""Where a landmark is that ranges and bearings alone observe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor

_AMBIGUOUS = 2 * np.log(20)  # difference of χ² up to which another place has a twentieth of the likelihood or more
_APART = 5.0  # standard deviations of the measurements beyond which two places are different ones
_SAME = 1e-3  # of the extent: what descents that end early leave
_FARTHEST = 100.0  # times the path's extent: farther bearings are parallel


def place(key: Key, factors: Sequence[Factor], poses: Array, dimension: int) -> Array:
    """Return the place ``(d,)`` of a landmark that fits its ranges and bearings best, from starts all around.

    Args:
        key: of the landmark.
        factors: ranges and bearings.
        poses: ``(M, 4, 4)`` that they are measured from.
        dimension: ``d``.

    Raises:
        GraphError: several places fit.
    """
    origins, R = poses[:, :dimension, 3], poses[:, :dimension, :dimension]
    is_range = np.array([factor.kind == "range" for factor in factors])
    sigmas = np.array([np.sqrt(np.diag(factor.noise.covariance).mean()) for factor in factors if factor.noise])
    ranges = np.array([f.measured[0] for f in factors if f.kind == "range"])
    directions = np.array([_direction(f, turn) for f, turn in zip(factors, R, strict=True) if f.kind == "bearing"])

    def residuals(point: Array) -> Array:
        off = point - origins
        distance = np.maximum(np.linalg.norm(off, axis=1), 1e-9)
        across = off[~is_range] / distance[~is_range, None] - directions.reshape(-1, dimension)
        return np.concatenate(
            [(distance[is_range] - ranges) / sigmas[is_range], (across / sigmas[~is_range, None]).ravel()]
        )

    extent = max(float(np.ptp(origins, axis=0).max()), float(ranges.max(initial=0.0)), 1e-3)
    starts = _starts(origins, directions, ranges, extent, dimension)
    ends = [least_squares(residuals, start, max_nfev=100) for start in starts]
    ends = [end for end in ends if np.linalg.norm(end.x - origins[0]) < _FARTHEST * extent]
    if not ends:
        raise GraphError(f"landmark {key}: its bearings are parallel; give add_landmark an initial value")
    best = min(ends, key=lambda end: end.cost)
    spread = np.sqrt(np.linalg.eigvalsh(np.linalg.pinv(best.jac.T @ best.jac)).max())
    apart = _APART * spread + _SAME * extent
    for other in ends:
        if 2 * (other.cost - best.cost) < _AMBIGUOUS and np.linalg.norm(other.x - best.x) > apart:
            raise GraphError(
                f"landmark {key}: its ranges allow several places, such as {_shown(best.x)} and {_shown(other.x)}; "
                f"give add_landmark an initial value near the right one"
            )
    return np.asarray(best.x)


def _direction(factor: Factor, R: Array) -> Array:
    """Return the unit direction ``(d,)`` of a bearing in world."""
    z = factor.measured
    return np.asarray(R @ (z if len(z) == 3 else np.array([np.cos(z[0]), np.sin(z[0])])))


def _starts(origins: Array, directions: Array, ranges: Array, extent: float, dimension: int) -> list[Array]:
    """Return points on the first bearing, or all around the first pose."""
    reach = float(np.median(ranges)) if len(ranges) else extent
    if len(directions):
        return [origins.mean(axis=0) + scale * reach * directions.mean(axis=0) for scale in (0.3, 1.0, 3.0)]
    corners = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * dimension)).reshape(dimension, -1).T
    around = corners[(corners != 0).any(axis=1)]
    return [origins.mean(axis=0) + reach * c / np.linalg.norm(c) for c in around]


def _shown(point: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"
