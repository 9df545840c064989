"""Where a trajectory lies in the frame of GPS fixes, and how far their clocks are apart, without bending it.

The rotation is Wahba's problem, solved by singular values (Markley, "Attitude determination using vector observations
and the singular value decomposition", JAS 1988), with positions and the direction up as observations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import EstimationError
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, GpsFix

MAX_SHIFT_S = 2.0
LEVEL_SIGMA_RAD = 0.1
_LEAST_FIXES = 3
_GRID_S = 0.05
_WINDOW = 40  # fixes; within as many a trajectory drifts little, whatever it does over all
_ROUNDS = 30
_ANNEALING = 1.5
_REJECTED_BEYOND = 3.0  # robust standard deviations
_MEDIAN_NORM = 1.538  # of three standard normal numbers


@dataclass(frozen=True, eq=False)
class FixAlignment:
    """How a trajectory's world lies in the fixes' frame.

    Attributes:
        T_enu_world: ``(4, 4)``.
        shift_s: a fix stamped ``t`` shows where the antenna was at ``t + shift_s`` of the trajectory's clock.
        covariance: ``(7, 7)`` of a right perturbation of ``T_enu_world`` and of the shift, from the residuals' spread
            as if they were independent.
        residuals_m: ``(M, 3)`` the placed antenna less the fix; NaN where the trajectory does not reach.
        used: ``(M,)`` whether the trajectory reaches.
        inliers: ``(M,)`` whether the fix agrees.
    """

    T_enu_world: Array
    shift_s: float
    covariance: Array
    residuals_m: Array
    used: NDArray[np.bool_]
    inliers: NDArray[np.bool_]

    @property
    def shift_sigma_s(self) -> float:
        """Standard deviation of the shift."""
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def rmse_m(self) -> float:
        """Root mean square distance of the fixes that agree."""
        return float(np.sqrt((self.residuals_m[self.inliers] ** 2).sum(axis=1).mean()))


def fix_stamps(fixes: Sequence[GpsFix], shift_s: float = 0.0) -> NDArray[np.int64]:
    """``(M,)`` the fixes' stamps moved to the trajectory's clock."""
    stamps = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    return stamps + round(shift_s * NS_PER_S)


def align_fixes(
    path: PosePath,
    fixes: Sequence[GpsFix],
    lever_m: Array,
    up_world: Array,
    up_sigma_rad: float,
    max_shift_s: float = MAX_SHIFT_S,
) -> FixAlignment:
    """Place a path rigidly on fixes, some of which may be wrong.

    The shift is the one for which pieces of the path fit best, each placed on its own, so that drift over the whole
    does not decide; where none fits clearly better, such as at constant speed on a straight road, it is near zero.

    Args:
        path: of the body.
        fixes: ``M`` of them, three or more that the path reaches.
        lever_m: ``(3,)`` the antenna in the body's frame.
        up_world: ``(3,)`` the direction up in the path's world; without it a straight path could roll about itself.
        up_sigma_rad: how far that may be off.
        max_shift_s: the clocks are no farther apart; 0 takes the stamps as they are.

    Raises:
        EstimationError: too few fixes in the path's time.
    """
    if not fixes:
        raise EstimationError(
            "no GPS fixes in the run's time to place it on; the recording needs some, by its scans' clock, see gps.csv"
        )
    up = up_world / np.linalg.norm(up_world)
    fit = _Fit(path, fixes, lever_m, up, up_sigma_rad)
    shift = fit.best_shift(max_shift_s) if max_shift_s > 0 else 0.0
    return fit.whole(shift, max_shift_s)


class _Fit:
    def __init__(self, path: PosePath, fixes: Sequence[GpsFix], lever_m: Array, up: Array, up_sigma_rad: float) -> None:
        self._path, self._lever, self._up, self._up_sigma = path, lever_m, up, up_sigma_rad
        self._stamps = fix_stamps(fixes)
        self._fixes = np.array([fix.position_m for fix in fixes], dtype=np.float64).reshape(-1, 3)

    def _at(self, shift_s: float) -> NDArray[np.int64]:
        return self._stamps + round(shift_s * NS_PER_S)

    def _too_few(self, count: int) -> EstimationError:
        return EstimationError(
            f"{count} of {len(self._stamps)} GPS fixes lie in the run's time; {_LEAST_FIXES} are needed; where their "
            "clock is another, allow a larger shift (--max-shift)"
        )

    def best_shift(self, most_s: float) -> float:
        grid = np.linspace(-most_s, most_s, 2 * math.ceil(most_s / _GRID_S) + 1)
        grid, kept = self._comparable(grid)
        rows = np.flatnonzero(kept)
        pieces = np.array_split(rows, max(len(rows) // _WINDOW, 1))

        def cost(shift_s: float) -> float:
            points, _ = self._path.points(self._at(shift_s), self._lever)
            squares = np.concatenate([self._robust(points[piece], self._fixes[piece])[2] for piece in pieces])
            scale = max(float(np.median(squares)) / _MEDIAN_NORM**2, 1e-8)
            bounded = np.minimum(squares / scale, _REJECTED_BEYOND**2 * 3).mean()
            return len(rows) * float(np.log(bounded * scale)) + (shift_s / most_s) ** 2

        if len(rows) < _LEAST_FIXES:
            raise self._too_few(len(rows))
        costs = [cost(float(shift)) for shift in grid]
        k = int(np.argmin(costs))
        ends = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])
        return float(minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-4}).x)

    def _comparable(self, grid: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Shifts, and the fixes to compare them by: the same for all, or leaving out some would look like a better fit.

        Where hardly any fix stays in the run's time whatever the shift, they are those of the time at no shift; or, if
        more are in it at another, as by a clock that is far off, those, at the shifts that keep them there.
        """
        always = self._path.covers(self._at(grid[0])) & self._path.covers(self._at(grid[-1]))
        if always.sum() >= _LEAST_FIXES:
            return grid, always
        covered = np.array([self._path.covers(self._at(float(shift))) for shift in grid])
        nearest = np.argsort(np.abs(grid), kind="stable")
        most = nearest[covered[nearest].sum(axis=1).argmax()]
        if most == nearest[0]:
            return grid, covered[most]
        return grid[covered[:, covered[most]].all(axis=1)], covered[most]

    def _robust(self, points: Array, fixes: Array) -> tuple[Array, Array, Array]:
        """Rigid motion, weights and squared distances, by Geman-McClure weights whose width shrinks to the spread."""
        weights = np.ones(len(points))
        width, spread = np.inf, 1.0
        for _ in range(_ROUNDS):
            T = self._rigid(points, fixes, weights, spread)
            squares = ((se3.transform(T, points) - fixes) ** 2).sum(axis=1)
            spread = max(float(np.median(squares)) / _MEDIAN_NORM**2, 1e-8)
            least = _REJECTED_BEYOND**2 * spread
            if width <= least:
                break
            width = max(float(squares.max()) if np.isinf(width) else width / _ANNEALING**2, least)
            weights = 1 / (1 + squares / width) ** 2
        return T, weights, squares

    def _rigid(self, points: Array, fixes: Array, weights: Array, spread2: float) -> Array:
        share = weights / weights.sum()
        p, q = share @ points, share @ fixes
        cross = (fixes - q).T @ ((points - p) * weights[:, None])
        # the direction up counts as much as its variance says beside that of a position
        U, _, Vt = np.linalg.svd(cross + spread2 / self._up_sigma**2 * np.outer([0.0, 0.0, 1.0], self._up))
        R = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        return se3.make(R, q - R @ p)

    def whole(self, shift_s: float, most_s: float) -> FixAlignment:
        stamps = self._at(shift_s)
        used = self._path.covers(stamps)
        if used.sum() < _LEAST_FIXES:
            raise self._too_few(int(used.sum()))
        points, velocities = self._path.points(stamps[used], self._lever)
        T, _, squares = self._robust(points, self._fixes[used])
        spread2 = max(float(np.median(squares)) / _MEDIAN_NORM**2, 1e-8)
        agree = squares <= 3 * _REJECTED_BEYOND**2 * spread2
        T = self._rigid(points, self._fixes[used], agree.astype(np.float64), spread2)
        residuals = np.full((len(stamps), 3), np.nan)
        residuals[used] = se3.transform(T, points) - self._fixes[used]
        inliers = used.copy()
        inliers[used] = agree
        spread2 = float((residuals[inliers] ** 2).mean())
        covariance = self._covariance(T, points[agree], velocities[agree], spread2, most_s)
        return FixAlignment(T, shift_s, covariance, residuals, used, inliers)

    def _covariance(self, T: Array, points: Array, velocities: Array, spread2: float, most_s: float) -> Array:
        R = T[:3, :3]
        J = np.concatenate([-R @ se3.hat(points), np.tile(R, (len(points), 1, 1)), (velocities @ R.T)[..., None]], 2)
        information = np.einsum("nij,nik->jk", J, J) / spread2
        level = se3.hat(self._up)
        information[:3, :3] += level.T @ level / self._up_sigma**2
        information[6, 6] += 1 / max(most_s, 1e-9) ** 2
        return np.asarray(np.linalg.inv(information))
