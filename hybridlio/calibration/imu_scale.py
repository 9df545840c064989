"""Scale and misalignment of an IMU, from the path that the scans give; no labels are needed.

An IMU's biases are variables of the graph. What is left of a low-cost IMU's errors is mostly linear in the motion:
sensitivities differ from the stated ones by 0.5 to 3 % and axes are not orthogonal by up to 2 % (data sheets of the
InvenSense ICM-20948 and the Bosch BMI160). Between scans that hardly counts; where scans are lost it does.

* Gyroscope: over windows of a second the rotation by rates ``M·ω - b`` is that of the path (Gauss-Newton).
* Accelerometer: for positions ``p0, p1, p2`` of the IMU at times ``T1`` and ``T2`` apart,
  ``(p2 - p1)/T2 - (p1 - p0)/T1 = ∫ w(t)·(R(t)·(A·f(t) - b) + g) dt``, where ``w`` rises from 0 to 1 over ``T1`` and
  falls to 0 over ``T2``: the velocity cancels, and what is left is linear in ``A``, ``b``, ``g`` and the lever arm.

Biases are linear between knots ten seconds apart. Windows are weighed by Huber's kernel, so that a few failed
registrations do not count. A prior of the data sheets' size keeps elements that the motion does not show where they
are: at the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.calibration.turns import GyroPath
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.core.trajectory import Trajectory

# Standard deviations of the elements before: on the diagonal the data sheets' tolerances of sensitivity, off it half of
# their tolerance across axes.
_GYRO_SIGMAS = np.where(np.eye(3) > 0, 0.015, 0.01).ravel()
_ACCEL_SIGMAS = np.where(np.eye(3) > 0, 0.005, 0.01).ravel()
_KNOTS_S = 10.0
# Random walks of the biases of consumer MEMS, the loosest kind, see simulation.platforms.imu_grades: 4e-5 rad/s²/√Hz
# and 6e-3 m/s³/√Hz; and the biases at power-up, 3 σ.
_GYRO_WALK, _ACCEL_WALK = 4.0e-5, 6.0e-3
_GYRO_BIAS, _ACCEL_BIAS = 0.1, 1.0
_GYRO_WINDOW_S, _ACCEL_WINDOW_S = 1.0, 0.5
_GRAVITY_M_S2, _GRAVITY_SIGMA_M_S2 = 9.807, 0.02  # on Earth, 9.78 to 9.83
_LEVER_SIGMA_M = 0.03  # of the stated one
_HUBER = 1.345  # standard deviations: 95 % efficiency with normal errors (Huber)
_ROUNDS = 6
_DIFFERENCE = 1e-4  # of finite differences: rotations are smooth in M, and float64 leaves 1e-12 of it
_QUADRATURE = 9  # orientations within a window, for the bias's effect
_LEAST_WINDOWS = 20
_LONGEST_S = 300.0  # of the path that is used: after a minute of motion elements are known to 1e-3

Rows = tuple[Array, Array]  # of a linear system and their right side, in standard deviations


@dataclass(frozen=True, eq=False)
class FoundScale:
    """What a path shows of an IMU's scale.

    Attributes:
        scale: the correction of the samples.
        gyro_covariance, accel_covariance: ``(9, 9)`` of the elements row by row; that of the prior where the motion
            shows nothing.
        gyro_prior_sigmas, accel_prior_sigmas: ``(9,)`` standard deviations of the elements before.
    """

    scale: ImuScale
    gyro_covariance: Array
    accel_covariance: Array
    gyro_prior_sigmas: Array = field(default_factory=_GYRO_SIGMAS.copy)
    accel_prior_sigmas: Array = field(default_factory=_ACCEL_SIGMAS.copy)

    @property
    def sigmas(self) -> tuple[Array, Array]:
        """Standard deviations ``(3, 3)`` of both matrices' elements."""
        gyro, accel = (np.sqrt(np.diag(c)).reshape(3, 3) for c in (self.gyro_covariance, self.accel_covariance))
        return gyro, accel


def find_imu_scale(path: Trajectory, imu: ImuSamples, T_imu_lidar: Array) -> FoundScale | None:
    """Fit an IMU's scale to a lidar's path.

    Args:
        path: of the lidar, one pose a scan.
        imu: samples on the path's clock, of any bias.
        T_imu_lidar: ``(4, 4)``; the corrected axes are those of its IMU frame.

    Returns:
        The scale with its covariance; None where the path has fewer than 20 windows with samples.
    """
    if len(path) < 2:
        return None
    path = _first_part(path)
    imu = imu.between(int(path.stamps_ns[0]), int(path.stamps_ns[-1]))
    if len(imu) < 2:
        return None
    poses = path.poses @ se3.inverse(T_imu_lidar)
    times_s, samples_s = ((stamps - path.stamps_ns[0]) / NS_PER_S for stamps in (path.stamps_ns, imu.stamps_ns))
    gyro = _fit_gyro(times_s, poses[:, :3, :3], imu, int(path.stamps_ns[0]))
    if gyro is None:
        return None
    M, gyro_covariance = gyro
    corrected = ImuScale(M).corrected(imu)
    R = _orientations(times_s, poses[:, :3, :3], corrected, int(path.stamps_ns[0]))
    accel = _fit_accel(times_s, poses, samples_s, R, imu.accel_m_s2)
    if accel is None:
        return None
    return FoundScale(ImuScale(M, accel[0]), gyro_covariance, accel[1])


def _first_part(path: Trajectory) -> Trajectory:
    used = path.stamps_ns - path.stamps_ns[0] <= _LONGEST_S * NS_PER_S
    return Trajectory(path.stamps_ns[used], path.poses[used])


def _fit_gyro(times_s: Array, R_world_imu: Array, imu: ImuSamples, origin_ns: int) -> tuple[Array, Array] | None:
    """Return ``M`` and the covariance of its elements."""
    ends = _windows(times_s, _GYRO_WINDOW_S)
    starts_s, ends_s = times_s[ends[:-1]], times_s[ends[1:]]
    whole = GyroPath(imu, origin_ns).covers(starts_s, ends_s)
    if whole.sum() < _LEAST_WINDOWS:
        return None
    measured = (np.swapaxes(R_world_imu[ends[:-1]], 1, 2) @ R_world_imu[ends[1:]])[whole]
    starts_s, ends_s = starts_s[whole], ends_s[whole]
    prior = _Prior(times_s, _GYRO_SIGMAS, _GYRO_BIAS, _GYRO_WALK)
    M, bias, covariance = np.eye(3), np.zeros((prior.knots, 3)), np.eye(9)
    weights = np.ones(len(measured))

    def residuals(matrix: Array) -> tuple[Array, GyroPath]:
        rates = (imu.gyro_rad_s - prior.at((imu.stamps_ns - origin_ns) / NS_PER_S) @ bias) @ matrix.T
        gyro = GyroPath(ImuSamples(imu.stamps_ns, rates, imu.accel_m_s2), origin_ns)
        turned = se3.so3_exp(gyro.turns(starts_s, ends_s))
        return se3.so3_log(np.swapaxes(turned, 1, 2) @ measured), gyro

    for _ in range(_ROUNDS):
        errors, gyro = residuals(M)
        by_matrix = [
            (errors - residuals(M + _DIFFERENCE * step)[0]) / _DIFFERENCE for step in np.eye(9).reshape(9, 3, 3)
        ]
        J = np.concatenate([np.stack(by_matrix, axis=-1), _by_bias(gyro, M, prior, starts_s, ends_s)], axis=-1)
        update, covariance, weights = _solve(J, errors, weights, prior.rows(M - np.eye(3), bias, J.shape[-1]))
        M, bias = M + update[:9].reshape(3, 3), bias + update[9:].reshape(-1, 3)
    return M, covariance[:9, :9]


def _by_bias(gyro: GyroPath, M: Array, prior: _Prior, starts_s: Array, ends_s: Array) -> Array:
    """Return derivatives ``(W, 3, 3K)`` of the windows' rotations by the biases at the knots."""
    total = np.zeros((len(starts_s), 3, prior.knots, 3))
    for part in (np.arange(_QUADRATURE) + 0.5) / _QUADRATURE:
        at_s = starts_s + part * (ends_s - starts_s)
        to_end = np.swapaxes(se3.so3_exp(gyro.turns(at_s, ends_s)), 1, 2)
        effect = -to_end @ M * ((ends_s - starts_s) / _QUADRATURE)[:, None, None]
        total += np.einsum("wij,wk->wikj", effect, prior.at(at_s))
    return total.reshape(len(starts_s), 3, -1)


def _orientations(times_s: Array, R_world_imu: Array, imu: ImuSamples, origin_ns: int) -> Array:
    """Return orientations ``(S, 3, 3)`` at the samples: the path's at the scan before, turned on by the gyroscope."""
    samples_s = (imu.stamps_ns - origin_ns) / NS_PER_S
    scan = np.clip(np.searchsorted(times_s, samples_s, side="right") - 1, 0, len(times_s) - 1)
    since = GyroPath(imu, origin_ns).turns(np.minimum(times_s[scan], samples_s), samples_s)
    return np.asarray(R_world_imu[scan] @ se3.so3_exp(since))


def _fit_accel(
    times_s: Array, poses: Array, samples_s: Array, R: Array, force_m_s2: Array
) -> tuple[Array, Array] | None:
    """Return ``A`` and the covariance of its elements."""
    rows = _windows(times_s, _ACCEL_WINDOW_S)
    prior = _Prior(times_s, _ACCEL_SIGMAS, _ACCEL_BIAS, _ACCEL_WALK)
    found = [
        _second_difference(times_s, poses, rows[k : k + 3], samples_s, R, force_m_s2, prior)
        for k in range(len(rows) - 2)
    ]
    parts = [part for part in found if part is not None]
    if len(parts) < _LEAST_WINDOWS:
        return None
    J, target = np.stack([part[0] for part in parts]), np.stack([part[1] for part in parts])
    x, weights, covariance = np.zeros(J.shape[-1]), np.ones(len(J)), np.eye(9)
    x[-6:-3] = np.median(target - J[..., :9] @ np.eye(3).ravel(), axis=0)  # gravity, the rest being right
    for _ in range(_ROUNDS):
        errors = target - J[..., :9] @ np.eye(3).ravel() - J @ x
        known = [*prior.rows(x[:9], x[9:-6], len(x)), _gravity_and_lever(x[-6:-3], x[-3:], len(x))]
        update, covariance, weights = _solve(J, errors, weights, known)
        x = x + update
    return np.eye(3) + x[:9].reshape(3, 3), covariance[:9, :9]


def _second_difference(
    times_s: Array, poses: Array, rows: Array, samples_s: Array, R: Array, force_m_s2: Array, prior: _Prior
) -> tuple[Array, Array] | None:
    """Return derivatives ``(3, 9 + 3K + 6)`` and the change of velocity over its duration; None without samples.

    The unknowns are the elements of ``A``, the biases, gravity in the path's frame and the error of the lever arm.
    """
    start, middle, end = times_s[rows]
    first, last = np.searchsorted(samples_s, [start, end])
    if last - first < 3 or np.diff(samples_s[first:last]).max() > _ACCEL_WINDOW_S / 4:
        return None
    at = samples_s[first:last]
    kernel = np.minimum((at - start) / (middle - start), (end - at) / (end - middle)) * np.gradient(at)
    kernel = kernel / kernel.sum()
    turned = kernel[:, None, None] * R[first:last]
    duration = (end - start) / 2
    change = (poses[rows[2]] - poses[rows[1]]) / (end - middle) - (poses[rows[1]] - poses[rows[0]]) / (middle - start)
    by_bias = -np.einsum("sij,sk->ikj", turned, prior.at(at)).reshape(3, -1)
    by_matrix = np.einsum("sij,sl->ijl", turned, force_m_s2[first:last]).reshape(3, 9)
    J = np.hstack([by_matrix, by_bias, np.eye(3), -change[:3, :3] / duration])
    return J, change[:3, 3] / duration


def _gravity_and_lever(gravity: Array, lever: Array, unknowns: int) -> Rows:
    """Return rows of a prior on gravity's size and on the lever arm, and their residuals, in standard deviations."""
    rows, size = np.zeros((4, unknowns)), float(np.linalg.norm(gravity))
    rows[0, -6:-3] = gravity / size / _GRAVITY_SIGMA_M_S2
    rows[1:, -3:] = np.eye(3) / _LEVER_SIGMA_M
    return rows, np.r_[(_GRAVITY_M_S2 - size) / _GRAVITY_SIGMA_M_S2, -lever / _LEVER_SIGMA_M]


def _windows(times_s: Array, length_s: float) -> Array:
    """Return rows of the path about ``length_s`` apart."""
    rows = np.searchsorted(times_s, np.arange(0.0, times_s[-1], length_s))
    return np.unique(np.clip(rows, 0, len(times_s) - 1))


class _Prior:
    """What is known before: sizes of a matrix's elements, and biases that walk and are linear between knots."""

    def __init__(self, times_s: Array, sigmas: Array, bias_sigma: float, walk: float) -> None:
        self._sigmas, self.knots = sigmas, max(int(np.ceil(times_s[-1] / _KNOTS_S)), 1) + 1
        difference = np.diff(np.eye(self.knots), axis=0) / (walk * np.sqrt(_KNOTS_S))
        self._walk = np.kron(np.vstack([difference, np.eye(self.knots)[:1] / bias_sigma]), np.eye(3))

    def at(self, times_s: Array) -> Array:
        """Return weights ``(N, K)`` of the knots."""
        place = np.clip(times_s / _KNOTS_S, 0, self.knots - 1)
        return np.asarray(np.maximum(1 - np.abs(place[:, None] - np.arange(self.knots)), 0.0))

    def rows(self, matrix: Array, bias: Array, unknowns: int) -> list[Rows]:
        """Return rows of the unknowns and their residuals, in standard deviations."""
        walk = np.zeros((len(self._walk), unknowns))
        walk[:, 9 : 9 + 3 * self.knots] = self._walk
        elements = np.eye(9, unknowns) / self._sigmas[:, None]
        return [(elements, -matrix.ravel() / self._sigmas), (walk, -self._walk @ bias.ravel())]


def _solve(J: Array, errors: Array, weights: Array, priors: list[Rows]) -> tuple[Array, Array, Array]:
    """Return the update of the unknowns, their covariance, and new weights of the windows."""
    sigmas = 1.4826 * np.median(np.abs(errors), axis=0) + 1e-12  # of normal errors, by their median
    J = J / sigmas[:, None]
    data = (J * np.sqrt(weights)[:, None, None]).reshape(-1, J.shape[-1])
    target = (errors / sigmas * np.sqrt(weights)[:, None]).ravel()
    A = np.vstack([data, *(rows for rows, _ in priors)])
    b = np.concatenate([target, *(values for _, values in priors)])
    inverse = np.linalg.inv(A.T @ A)
    update = inverse @ (A.T @ b)
    left = errors / sigmas - J @ update
    covariance = inverse @ _spread(J, left, weights, priors) @ inverse
    lengths = np.linalg.norm(left, axis=1) / np.sqrt(3)
    return update, covariance, _HUBER / np.maximum(lengths, _HUBER)


def _spread(J: Array, left: Array, weights: Array, priors: list[Rows]) -> Array:
    """Return the variance of the normal equations' right side.

    Windows of violent motion have larger errors and more leverage; the residuals show both (sandwich estimator, White
    1980), where one variance for all windows gives 2 to 3 times too small a covariance.
    """
    pulls = np.einsum("wiu,wi->wu", J, left) * weights[:, None]
    freedom = max(1.0 - J.shape[-1] / left.size, 0.1)
    return np.asarray(pulls.T @ pulls / freedom + sum(rows.T @ rows for rows, _ in priors))
