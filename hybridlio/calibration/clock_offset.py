"""The offset between the clocks of lidar and IMU, from the rotations that both measure.

If its stamps are moved by ``δ``, the gyroscope turns by ``g_k(δ)`` over step ``k``, and the lidar by ``u_k`` as seen
from the IMU. With the gyroscope's bias ``b`` and a small rotation ``φ`` between the stated and the true mounting,

    ``g_k(δ) - b·Δt_k = Exp(φ)·u_k + e_k``.

The errors ``e_k`` are the gyroscope's noise and those of the lidar's poses: a drift that adds up and a scatter that the
next step takes back, so neighbouring steps are anticorrelated. Both are estimated from the residuals
(:class:`~hybridlio.calibration.step_noise.StepNoise`).

The derivative of ``g_k`` by ``δ`` is a difference of two of the gyroscope's rates, and in calm motion holds as much
noise as signal. Least squares would take the noise for information, and halve the standard deviation. The residuals are
therefore made orthogonal to an instrument that is free of this noise (instrumental variables; Söderström, Stoica,
"System Identification", 1989, chapter 8): the derivative that the lidar's own turns before and after a step give,
``(u_{k-2} - 8 u_{k-1} + 8 u_{k+1} - u_{k+2}) / 12 Δt``. It is independent of the scatter in step ``k`` too, as it is
antisymmetric.

Errors of registration may also agree over many steps, on one wall or in one bend. The covariance is therefore the
larger one of that of independent errors and of the estimate that holds for any errors with a limited memory (Newey,
West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
Econometrica 55, 1987).

Axes of the lidar about which a step was not measured are left out: on open ground a scan's yaw stays where the
registration began, and would show the motion that was proposed, not the lidar's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.calibration.step_noise import LEAST_SIGMA_RAD, StepNoise, mean_square
from hybridlio.calibration.turns import GyroPath, Turns
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples

_GRID_S = 0.01  # of the search; rates of vehicles and hands change little within it
_MIN_STEPS = 50  # seven parameters need many times more steps
_ROTATION_SIGMA_RAD = 0.05  # of stated mountings; 3° is what a hand measures
_ITERATIONS = 12  # each also renews the weights; the offset settles to microseconds in 4 to 8
_SETTLED_S = 1e-6
_DIFFERENCE_S = 1e-3  # of the numeric derivative by the offset, below any time between samples
_OUTLIER_SIGMAS = 5.0  # of a step's residual: a jump of the odometry
_MEMORY_STEPS = 10  # of errors that agree: one second at 10 Hz, in which surroundings of a lidar change
_COMPENSATION_S = 2e-4  # error of motion compensation: 0.2 to 0.3 ms remain on five of twelve development drives
_CLIP_QUANTILE = 0.95  # of turn rates, where the search stops counting differences: a jump must not decide
# An offset is applied from 3 ms on: below it, the errors of interpolating 100 Hz samples and of the lidar's own stamps
# are as large, and drift does not change measurably (benchmarks/clock_offsets.py).
LEAST_OFFSET_S = 0.003
_SIGNIFICANT_SIGMAS = 4.0  # by chance once in 16,000 recordings
_CONTRADICTION = 0.5  # as much unexplained in spite of a clear motion: nothing but wrong data does that
_CLEAR_TURN_RAD = 0.005  # over a step, ten times the noise of registration; ordinary driving with bends reaches 0.01
_LARGEST_UNEXPLAINED = 0.3  # of squared turns: with more, lidar and gyroscope do not measure one motion


@dataclass(frozen=True, eq=False)
class ClockOffset:
    """The offset of the clocks and what was estimated with it.

    Attributes:
        offset_s: seconds to add to the IMU's stamps to bring them to the lidar's clock.
        sigma_s: its standard deviation; infinite where the motion does not determine it.
        gyro_bias_rad_s: ``(3,)``.
        rotation_rad: ``(3,)`` rotation vector from the stated to the estimated mounting: the latter is
            ``Exp(rotation) @ R_imu_lidar``.
        rotation_sigma_rad: ``(3,)``.
        steps: number of steps that were compared.
        unexplained: variance of the residuals over that of the turns, the harmonic mean of the three axes: 0 is a
            perfect fit about any axis, as open ground leaves the yaw of scans unknown and a plane drive has only yaw.
        unexplained_at_zero: the same without moving the stamps.
        stated_rotation_ratio: variance of the residuals by the stated mounting over that by the estimated one, the mean
            of the axes.
        turned_rad: standard deviation of the lidar's turns over a step.
    """

    offset_s: float
    sigma_s: float
    gyro_bias_rad_s: Array
    rotation_rad: Array
    rotation_sigma_rad: Array
    steps: int
    unexplained: float
    unexplained_at_zero: float
    turned_rad: float
    stated_rotation_ratio: float

    @property
    def is_determined(self) -> bool:
        """Whether lidar and gyroscope measure one motion, and it fixes the offset better than to 3 ms."""
        return self._is_one_motion and self.sigma_s < LEAST_OFFSET_S

    @property
    def is_significant(self) -> bool:
        """Whether the clocks differ: by more than chance explains, and by enough to matter."""
        least_s = max(LEAST_OFFSET_S, _SIGNIFICANT_SIGMAS * self.sigma_s)
        return self._is_one_motion and abs(self.offset_s) > least_s and self.unexplained < self.unexplained_at_zero

    @property
    def _is_one_motion(self) -> bool:
        return self.unexplained < _LARGEST_UNEXPLAINED

    @property
    def contradicts(self) -> bool:
        """Whether the lidar turns clearly more than its noise, and the gyroscope does not measure it."""
        return self.unexplained > _CONTRADICTION and self.turned_rad > _CLEAR_TURN_RAD

    def __str__(self) -> str:
        return f"{1e3 * self.offset_s:+.1f} ± {1e3 * self.sigma_s:.1f} ms"

    def applied_to(self, imu: ImuSamples) -> ImuSamples:
        """Return the samples on the lidar's clock."""
        return ImuSamples(imu.stamps_ns + round(self.offset_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)


def find_clock_offset(
    turns: Turns, imu: ImuSamples, R_imu_lidar: Array, largest_s: float, noise: ImuNoise | None = None
) -> ClockOffset | None:
    """Return the offset within ``±largest_s``, or None with samples for fewer than 50 steps.

    Args:
        turns: of the lidar.
        imu: the samples.
        R_imu_lidar: ``(3, 3)`` stated mounting.
        largest_s: bound of the search.
        noise: the deviation of the gyroscope's bias at power-up.
    """
    if len(imu) < 2 or len(turns) < _MIN_STEPS:
        return None
    fit = _Fit(turns, imu, R_imu_lidar, noise or ImuNoise())
    start_s = fit.search(largest_s)
    return None if start_s is None else fit.refine(start_s, largest_s)


def coarse_clock_offset(turns: Turns, imu: ImuSamples, largest_s: float) -> float | None:
    """Return the offset to 10 ms, whatever the mounting and the gyroscope's unit; None with too few samples."""
    if len(imu) < 2 or len(turns) < _MIN_STEPS:
        return None
    return _Fit(turns, imu, np.eye(3), ImuNoise()).search(largest_s)


class _Fit:
    """One comparison of turns with a gyroscope."""

    def __init__(self, turns: Turns, imu: ImuSamples, R_imu_lidar: Array, noise: ImuNoise) -> None:
        origin_ns = int(turns.starts_ns[0])
        self._path = GyroPath(imu, origin_ns)
        self._turns = turns
        self._starts = (turns.starts_ns - origin_ns) / NS_PER_S
        self._ends = (turns.ends_ns - origin_ns) / NS_PER_S
        self._R, self._measured = R_imu_lidar, turns.measured
        self._u = turns.rotvecs @ R_imu_lidar.T
        self._prior = np.r_[0.0, np.full(3, noise.gyro_bias_sigma_rad_s**-2.0), np.full(3, _ROTATION_SIGMA_RAD**-2)]

    def search(self, largest_s: float) -> float | None:
        """Return the offset on a grid at which the magnitudes of the rates correlate best.

        They depend neither on the mounting nor on the gyroscope's unit.
        """
        steps = int(np.ceil(largest_s / _GRID_S))
        grid = np.arange(-steps, steps + 1) * _GRID_S
        spans = self._turns.spans_s
        speeds = _clipped(np.linalg.norm(self._u, axis=1) / spans)
        correlations = np.full(len(grid), -np.inf)
        for k, offset in enumerate(grid):
            starts, ends = self._starts - offset, self._ends - offset
            whole = self._path.covers(starts, ends)
            if whole.sum() >= _MIN_STEPS:
                gyro = np.linalg.norm(self._path.integrals(starts[whole], ends[whole]), axis=1) / spans[whole]
                correlations[k] = _correlation(_clipped(gyro), speeds[whole])
        return float(grid[correlations.argmax()]) if np.isfinite(correlations).any() else None

    def refine(self, offset_s: float, largest_s: float) -> ClockOffset | None:
        """Return the offset of least weighted squares from a start within 20 ms of it."""
        x = np.r_[offset_s, np.zeros(6)]
        for _ in range(_ITERATIONS):
            whole = self._whole(x[0])
            if whole.sum() < _MIN_STEPS:
                return None
            kept, joined, noise = self._weights(x, whole)
            J = self._jacobian(x, kept)
            Z = noise.whitened(joined, self._instruments(J, kept))
            J = noise.whitened(joined, J)
            residuals = noise.whitened(joined, self._residuals(x, kept)[:, :, None])
            scores = (Z * residuals).sum(axis=1)
            normal = np.einsum("nai,naj->ij", Z, J) + np.diag(self._prior)
            gradient = scores.sum(axis=0) + self._prior * np.r_[0.0, x[1:]]
            step = np.linalg.lstsq(normal, gradient, rcond=None)[0]
            step[0] = np.clip(step[0], -2 * _GRID_S, 2 * _GRID_S)
            x = x - step
            x[0] = np.clip(x[0], -largest_s, largest_s)
            if abs(step[0]) < _SETTLED_S:
                break
        sigmas = self._sigmas(normal, Z, scores, kept)
        at_zero = np.r_[0.0, x[1:]]
        return ClockOffset(
            float(x[0]), float(sigmas[0]), x[1:4], x[4:], sigmas[4:], int(kept.sum()),
            self._unexplained(x, kept), self._unexplained(at_zero, kept & self._whole(0.0)),
            float(np.sqrt(self._u[kept].var(axis=0).sum())), self._stated_rotation_ratio(x, kept),
        )  # fmt: skip

    def _sigmas(self, normal: Array, instruments: Array, scores: Array, kept: Mask) -> Array:
        """Return the standard deviations ``(7,)``: of independent errors, or of errors that agree over some steps.

        Args:
            normal: ``(7, 7)`` products of instruments and derivatives.
            instruments: ``(M, 3, 7)`` whitened.
            scores: ``(M, 7)`` products of instruments and residuals.
            kept: ``(N,)`` the ``M`` steps.
        """
        if not instruments[:, :, 0].any():
            return np.full(7, np.inf)
        at = np.zeros((len(kept), 7))
        at[kept] = scores
        spread = at.T @ at + np.diag(self._prior)
        for lag in range(1, min(_MEMORY_STEPS, len(at) - 1) + 1):
            product = at[lag:].T @ at[:-lag]
            spread += (1 - lag / (_MEMORY_STEPS + 1)) * (product + product.T)
        inverse = np.linalg.pinv(normal)
        independent = np.einsum("nai,naj->ij", instruments, instruments) + np.diag(self._prior)
        variances = np.max([np.diag(inverse @ meat @ inverse.T) for meat in (independent, spread)], axis=0)
        variances[0] += _COMPENSATION_S**2
        return np.asarray(np.sqrt(variances))

    def _whole(self, offset: float) -> Mask:
        return self._path.covers(self._starts - offset - _DIFFERENCE_S, self._ends - offset + _DIFFERENCE_S)

    def _weights(self, x: Array, whole: Mask) -> tuple[Mask, Mask, StepNoise]:
        """Return the rows without outliers ``(N,)``, which of them are joined to the next, and their noise."""
        residuals = np.zeros_like(self._u)
        residuals[whole] = self._residuals(x, whole)
        sizes = np.where(self._measured[whole], np.abs(residuals[whole]), np.nan)
        medians = [np.median(column[column >= 0]) if (column >= 0).any() else 0.0 for column in sizes.T]
        scale = 1.4826 * np.array(medians) + LEAST_SIGMA_RAD
        kept = whole & (np.abs(residuals) < _OUTLIER_SIGMAS * scale).all(axis=1)
        rows = np.flatnonzero(kept)
        measured = self._measured[rows]
        joined = ((np.diff(rows) == 1) & self._turns.joined[rows[:-1]])[:, None] & measured[1:] & measured[:-1]
        return kept, joined, StepNoise.of(residuals[kept], measured, joined)

    def _residuals(self, x: Array, rows: Mask) -> Array:
        """Return residuals ``(M, 3)`` along the lidar's axes by the stated mounting, 0 where not measured."""
        gyro = self._path.turns(self._starts[rows] - x[0], self._ends[rows] - x[0])
        errors = gyro - x[1:4] * self._turns.spans_s[rows, None] - self._u[rows] @ se3.so3_exp(x[4:]).T
        return np.asarray(errors @ self._R * self._measured[rows])

    def _jacobian(self, x: Array, rows: Mask) -> Array:
        J = np.zeros((int(rows.sum()), 3, 7))
        step = np.eye(7)[0] * _DIFFERENCE_S
        J[:, :, 0] = (self._residuals(x + step, rows) - self._residuals(x - step, rows)) / (2 * _DIFFERENCE_S)
        J[:, :, 1:4] = -self._R.T * self._turns.spans_s[rows, None, None]
        turned = self._u[rows] @ se3.so3_exp(x[4:]).T
        J[:, :, 4:] = self._R.T @ se3.hat(turned)  # Exp(φ + dφ)·u ≈ Exp(φ)·u - hat(Exp(φ)·u)·dφ
        return np.asarray(J * self._measured[rows, :, None])

    def _instruments(self, J: Array, rows: Mask) -> Array:
        """Return the derivatives ``(M, 3, 7)`` with the offset's replaced by those of the lidar's turns.

        They are 0 where a turn before or after is missing, an outlier, or not measured about the axis.
        """
        u = self._turns.rotvecs / self._turns.spans_s[:, None]
        known = self._turns.measured & rows[:, None]
        joined = np.r_[False, self._turns.joined, False]  # before each step, and after the last one
        slopes, whole = np.zeros_like(u), np.zeros(u.shape, bool)
        slopes[2:-2] = (u[:-4] - 8 * u[1:-3] + 8 * u[3:-1] - u[4:]) / 12
        chain = joined[1:-4] & joined[2:-3] & joined[3:-2] & joined[4:-1]
        whole[2:-2] = known[:-4] & known[1:-3] & known[3:-1] & known[4:] & chain[:, None]
        Z = J.copy()
        Z[:, :, 0] = -(slopes * whole)[rows] * self._turns.measured[rows]
        return Z

    def _stated_rotation_ratio(self, x: Array, rows: Mask) -> float:
        stated, estimated = (self._variances(y, rows) for y in (np.r_[x[:4], np.zeros(3)], x))
        return float((stated / np.maximum(estimated, LEAST_SIGMA_RAD**2)).mean())

    def _unexplained(self, x: Array, rows: Mask) -> float:
        if not rows.any():
            return np.inf
        turned, known = self._turns.rotvecs[rows], self._measured[rows].any(axis=0)
        ratios = self._variances(x, rows)[known] / np.maximum(turned.var(axis=0)[known], 1e-12)
        return float(3 / (1 / np.maximum(ratios, 1e-9)).sum()) if known.any() else np.inf

    def _variances(self, x: Array, rows: Mask) -> Array:
        """Return the residuals' variances ``(3,)`` about the lidar's axes."""
        residuals, measured = self._residuals(x, rows), self._measured[rows]
        mean = residuals.sum(axis=0) / np.maximum(measured.sum(axis=0), 1)
        return mean_square((residuals - mean) * measured, measured)


def _clipped(rates: Array) -> Array:
    """Return rates ``(N,)`` with the largest few cut: a jump of the odometry must not decide."""
    return np.minimum(rates, np.quantile(rates, _CLIP_QUANTILE))


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))
