"""Alignment of a trajectory with GPS fixes: one rigid motion and one shift of the clocks, without bending it.

The rotation is Wahba's problem, solved by singular values (Markley, "Attitude determination using vector observations
and the singular value decomposition", JAS 1988), with positions and the direction up as observations. Wrong fixes are
outweighed by graduated non-convexity with the Geman-McClure kernel (Yang et al., RA-L 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.core.errors import EstimationError
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, GpsFix

MAX_SHIFT_S = 2.0  # covers clocks set over a network and receivers that report late; GPS time, 18 s off UTC, needs more
LEVEL_SIGMA_RAD = 0.1  # tilt of a lidar at the start, without an IMU to measure it: 6 degrees, a steep road
_LEAST_FIXES = 3  # that determine a rigid motion
_GRID_S = 0.05  # half of a 10 Hz lidar's period: motion hardly changes within it, so the cost has no narrower minimum
_PIECE_FIXES = 40  # consecutive fixes that are aligned together; over so few, odometry drifts little
_MAX_ROUNDS = 30  # the kernel's width shrinks by 1.5^30 = 2e5 at most
_ANNEALING = 1.5  # factor by which the width of the kernel shrinks, near the 1.4 of graduated non-convexity
_OUTLIER_SIGMAS = 3.0  # robust standard deviations per axis
_MEDIAN_NORM = 1.538  # median norm of three standard normal numbers, the root of the median of χ² (2.366)
_LEAST_VARIANCE_M2 = 1e-8  # of residuals: 0.1 mm, for fixes without noise


@dataclass(frozen=True, eq=False)
class FixAlignment:
    """The pose of a trajectory's world in the frame of the fixes.

    Attributes:
        T_enu_world: ``(4, 4)``.
        shift_s: a fix stamped ``t`` is of the antenna at ``t + shift_s`` by the trajectory's clock.
        covariance: ``(7, 7)`` of a right perturbation of ``T_enu_world`` and of the shift, from the residuals' variance
            as if they were independent.
        residuals_m: ``(M, 3)`` aligned antenna minus fix; NaN for fixes outside the trajectory's time.
        used: ``(M,)`` whether the fix lies in the trajectory's time.
        inliers: ``(M,)`` whether it also agrees with the alignment.
    """

    T_enu_world: Array
    shift_s: float
    covariance: Array
    residuals_m: Array
    used: Mask
    inliers: Mask

    @property
    def shift_sigma_s(self) -> float:
        """Standard deviation of the shift."""
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def rmse_m(self) -> float:
        """Root mean square distance to the inliers."""
        return float(np.sqrt((self.residuals_m[self.inliers] ** 2).sum(axis=1).mean()))


def fix_stamps(fixes: Sequence[GpsFix], shift_s: float = 0.0) -> Index:
    """Return the fixes' stamps ``(M,)`` in nanoseconds, moved to the trajectory's clock."""
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
    """Align a path with fixes, some of which may be wrong.

    The shift is the one at which short pieces of the path fit best, each aligned by itself, so that drift along the
    whole path has no influence. Where no shift fits clearly better, as at constant speed on a straight road, it stays
    near zero.

    Args:
        path: of the body.
        fixes: ``M`` of them; at least three must lie in the path's time.
        lever_m: ``(3,)`` the antenna in the body's frame.
        up_world: ``(3,)`` up in the path's world, of any length; without it a straight path could roll about itself.
        up_sigma_rad: its standard deviation.
        max_shift_s: largest difference of the clocks; 0 takes the stamps as they are.

    Raises:
        EstimationError: too few fixes lie in the path's time.
    """
    if not fixes:
        raise EstimationError(
            "no GPS fixes in the run's time, so it cannot be aligned; the recording must have fixes stamped by the "
            "clock of its scans, see gps.csv"
        )
    up = up_world / np.linalg.norm(up_world)
    aligner = _Aligner(path, fixes, lever_m, up, up_sigma_rad)
    shift_s = aligner.best_shift(max_shift_s) if max_shift_s > 0 else 0.0
    return aligner.aligned(shift_s, max_shift_s)


class _Aligner:
    """Aligns one path with one set of fixes; arguments as :func:`align_fixes`, ``up`` of unit length."""

    def __init__(self, path: PosePath, fixes: Sequence[GpsFix], lever_m: Array, up: Array, up_sigma_rad: float) -> None:
        self._path, self._lever, self._up, self._up_sigma = path, lever_m, up, up_sigma_rad
        self._stamps = fix_stamps(fixes)
        self._fixes = np.array([fix.position_m for fix in fixes], dtype=np.float64).reshape(-1, 3)

    def _at(self, shift_s: float) -> Index:
        """Stamps of the fixes by the path's clock."""
        return self._stamps + round(shift_s * NS_PER_S)

    def _too_few(self, count: int) -> EstimationError:
        return EstimationError(
            f"{count} of {len(self._stamps)} GPS fixes lie in the run's time; {_LEAST_FIXES} are needed; if their "
            "clock differs from that of the scans, allow a larger shift (--max-shift)"
        )

    def best_shift(self, max_shift_s: float) -> float:
        """Return the shift of least cost: a grid over all shifts, then a bounded search about the best.

        Raises:
            EstimationError: too few fixes lie in the path's time.
        """
        grid = np.linspace(-max_shift_s, max_shift_s, 2 * math.ceil(max_shift_s / _GRID_S) + 1)
        grid, kept = self._comparable(grid)
        rows = np.flatnonzero(kept)
        pieces = np.array_split(rows, max(len(rows) // _PIECE_FIXES, 1))

        def cost(shift_s: float) -> float:
            """Twice the negative log-likelihood of unknown variance, with bounded residuals, and the shift's prior."""
            points, _ = self._path.points(self._at(shift_s), self._lever)
            squares = np.concatenate([self._robust_motion(points[piece], self._fixes[piece])[2] for piece in pieces])
            variance = _robust_variance(squares)
            bounded = np.minimum(squares / variance, _OUTLIER_SIGMAS**2 * 3).mean()
            return len(rows) * float(np.log(bounded * variance)) + (shift_s / max_shift_s) ** 2

        if len(rows) < _LEAST_FIXES:
            raise self._too_few(len(rows))
        costs = [cost(float(shift)) for shift in grid]
        k = int(np.argmin(costs))
        ends = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])
        return float(minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-4}).x)

    def _comparable(self, grid: Array) -> tuple[Array, Mask]:
        """Return shifts and the fixes to compare them by.

        All shifts must be compared by the same fixes, because leaving out some would look like a better fit: those in
        the path's time at every shift. If these are too few, the fixes in its time without a shift are taken; or, if
        another shift brings more into it (a clock that is far off), those of that shift, at the shifts that keep them.
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

    def _robust_motion(self, points: Array, fixes: Array) -> tuple[Array, Array, Array]:
        """Return rigid motion, weights and squared distances; Geman-McClure weights shrink to the residuals' spread."""
        weights = np.ones(len(points))
        width, variance = np.inf, 1.0  # squared width of the kernel; at first all fixes count alike
        for _ in range(_MAX_ROUNDS):
            T = self._rigid_motion(points, fixes, weights, variance)
            squares = ((se3.transform(T, points) - fixes) ** 2).sum(axis=1)
            variance = _robust_variance(squares)
            least = _OUTLIER_SIGMAS**2 * variance
            if width <= least:
                break
            width = max(float(squares.max()) if np.isinf(width) else width / _ANNEALING**2, least)
            weights = 1 / (1 + squares / width) ** 2
        return T, weights, squares

    def _rigid_motion(self, points: Array, fixes: Array, weights: Array, variance_m2: float) -> Array:
        """Return the motion of least weighted squares that maps points to fixes and ``up`` to the z axis."""
        share = weights / weights.sum()
        p, q = share @ points, share @ fixes
        cross = (fixes - q).T @ ((points - p) * weights[:, None])
        # the direction up is one more observation, weighted by the ratio of a position's variance to its own
        U, _, Vt = np.linalg.svd(cross + variance_m2 / self._up_sigma**2 * np.outer([0.0, 0.0, 1.0], self._up))
        R = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        return se3.make(R, q - R @ p)

    def aligned(self, shift_s: float, max_shift_s: float) -> FixAlignment:
        """Return the alignment of the whole path at a shift.

        Raises:
            EstimationError: too few fixes lie in the path's time.
        """
        stamps = self._at(shift_s)
        used = self._path.covers(stamps)
        if used.sum() < _LEAST_FIXES:
            raise self._too_few(int(used.sum()))
        points, velocities = self._path.points(stamps[used], self._lever)
        _, _, squares = self._robust_motion(points, self._fixes[used])
        variance = _robust_variance(squares)
        agree = squares <= 3 * _OUTLIER_SIGMAS**2 * variance
        T = self._rigid_motion(points, self._fixes[used], agree.astype(np.float64), variance)
        residuals = np.full((len(stamps), 3), np.nan)
        residuals[used] = se3.transform(T, points) - self._fixes[used]
        inliers = used.copy()
        inliers[used] = agree
        variance = float((residuals[inliers] ** 2).mean())
        covariance = self._covariance(T, points[agree], velocities[agree], variance, max_shift_s)
        return FixAlignment(T, shift_s, covariance, residuals, used, inliers)

    def _covariance(self, T: Array, points: Array, velocities: Array, variance_m2: float, max_shift_s: float) -> Array:
        """Return ``(7, 7)`` of motion and shift: the inverse Hessian of positions, direction up and shift's prior."""
        R = T[:3, :3]
        J = np.concatenate([-R @ se3.hat(points), np.tile(R, (len(points), 1, 1)), (velocities @ R.T)[..., None]], 2)
        information = np.einsum("nij,nik->jk", J, J) / variance_m2
        level = se3.hat(self._up)
        information[:3, :3] += level.T @ level / self._up_sigma**2
        information[6, 6] += 1 / max(max_shift_s, 1e-9) ** 2
        return np.asarray(np.linalg.inv(information))


def _robust_variance(squares: Array) -> float:
    """Variance per axis in m² from the median of squared distances in three dimensions."""
    return max(float(np.median(squares)) / _MEDIAN_NORM**2, _LEAST_VARIANCE_M2)
