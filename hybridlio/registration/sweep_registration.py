"""Registration of a sweep during which the lidar's motion is not known: its pose and its motion together.

A sweep without inertial data is compensated by a guess. If the guess turns wrongly by ``θ(τ)`` until a point's time
``τ`` after the stamp, and moves wrongly by ``d(τ)``, a point ``p`` lies at

    ``x(τ) = T·(Exp(θ(τ))·p + d(τ))``

on the surface, with the pose ``T`` at the stamp. Scans that are compensated alike fit each other whatever ``θ`` is;
only a surface that is made of a well compensated scan tells it. Both errors are quadratic in time, so that rate and
velocity change linearly: ``θ(τ) = s·θ₁ + s²·θ₂`` with ``s = min(τ/u, 1)``, where ``u`` is the time without samples, and
``d(τ) = s·d₁ + s²·d₂`` with the sweep's duration in place of ``u``. Residuals and weights are those of
:mod:`hybridlio.registration.surface`, and priors on the rate's and the velocity's errors at both ends keep the
polynomials where the points do not tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import MEASUREMENT_FLOOR_SIGMAS
from hybridlio.registration.settings import MATCH_KERNELS, RegistrationSettings
from hybridlio.registration.surface import PlaneMatches, Surface

_POSE, _TURN, _SHIFT = slice(0, 6), slice(6, 12), slice(12, 18)
_ITERATIONS = 15
_WIDEST_KERNELS = 8  # of the first kernel, which is halved at every step
_SETTLED = 1e-4  # rad and m; a hundredth of what a scan is known by


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sweep, compensated by a guess.

    Attributes:
        points: ``(N, 3)`` in the lidar's frame at the stamp, by the guess.
        times_s: ``(N,)`` of the points, after the stamp.
        without_s: time after the stamp without samples.
        rate_sigmas_rad_s: standard deviations of the guessed rate at the stamp and at the end of that time.
        speed_sigmas_m_s: of the guessed velocity at the stamp and at the end of the sweep.
    """

    points: Array
    times_s: Array
    without_s: float
    rate_sigmas_rad_s: tuple[float, float]
    speed_sigmas_m_s: tuple[float, float]

    @property
    def bases(self) -> tuple[Array, Array]:
        """Powers of time ``(N, 2)`` that turn and shift are made of."""
        turning = np.clip(self.times_s / self.without_s, 0.0, 1.0)[:, None]
        moving = (self.times_s / self.duration_s)[:, None]
        return turning ** [1, 2], moving ** [1, 2]

    @property
    def duration_s(self) -> float:
        """Time from the stamp to the last point."""
        return float(self.times_s.max())

    @property
    def prior(self) -> Array:
        """Information ``(18, 18)`` of the unknowns; none of the pose."""
        turn = _ends(self.without_s, *self.rate_sigmas_rad_s)
        return np.asarray(block_diag(np.zeros((6, 6)), turn, _ends(self.duration_s, *self.speed_sigmas_m_s)))

    def moved(self, turn: Array, shift: Array) -> Array:
        """Return the points ``(N, 3)`` with errors of the guess, ``(2, 3)`` each, taken back."""
        turning, moving = self.bases
        return np.asarray(np.einsum("nij,nj->ni", se3.so3_exp(turning @ turn), self.points) + moving @ shift)


def _ends(time_s: float, first_sigma: float, last_sigma: float) -> Array:
    """Return the information ``(6, 6)`` of the coefficients of ``s`` and ``s²`` from their derivative at both ends."""
    at_first, at_last = np.array([1.0, 0.0]) / (first_sigma * time_s), np.array([1.0, 2.0]) / (last_sigma * time_s)
    information = np.outer(at_first, at_first) + np.outer(at_last, at_last)
    return np.asarray(np.kron(information, np.eye(3)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SweepPose:
    """Where a sweep lies.

    Attributes:
        pose: ``(4, 4)`` of the lidar at the sweep's stamp, in the surface's frame.
        covariance: ``(6, 6)`` of a right perturbation.
        matched: share of the points with a plane.
        cost: mean robust cost of all points, 0 to 1.
    """

    pose: Array
    covariance: Array
    matched: float
    cost: float


def register_sweep(
    surface: Surface, sweep: Sweep, pose: Array, settings: RegistrationSettings, scale: float
) -> SweepPose:
    """Find the pose of a sweep together with the errors of its compensation.

    Args:
        surface: of scans that are compensated well.
        sweep: the sweep.
        pose: ``(4, 4)`` to start from.
        settings: kernel, greatest distance of a match, threads.
        scale: ratio of the covariance to that of independent residuals.
    """
    turn, shift, kernel_m = np.zeros((2, 3)), np.zeros((2, 3)), _WIDEST_KERNELS * settings.kernel_m
    for _ in range(_ITERATIONS):
        system = _linearised(surface, sweep, pose, turn, shift, kernel_m, settings)
        information = system.hessian / (scale * system.variance_m2) + sweep.prior
        pull = (
            system.gradient / (scale * system.variance_m2)
            + sweep.prior @ np.r_[np.zeros(6), turn.ravel(), shift.ravel()]
        )
        step = -np.linalg.solve(information + 1e-6 * np.eye(18), pull)
        pose = pose @ se3.exp(step[_POSE])
        turn, shift = turn + step[_TURN].reshape(2, 3), shift + step[_SHIFT].reshape(2, 3)
        is_narrow, kernel_m = kernel_m <= settings.kernel_m, max(kernel_m / 2, settings.kernel_m)
        if is_narrow and np.abs(step).max() < _SETTLED:
            break
    covariance = np.linalg.inv(information)[_POSE, _POSE] + np.diag(MEASUREMENT_FLOOR_SIGMAS**2)
    return SweepPose(se3.orthonormalise(pose), (covariance + covariance.T) / 2, system.matched, system.cost)


@dataclass(frozen=True, eq=False)
class _System:
    hessian: Array
    gradient: Array
    variance_m2: float
    matched: float
    cost: float


def _linearised(
    surface: Surface,
    sweep: Sweep,
    pose: Array,
    turn: Array,
    shift: Array,
    kernel_m: float,
    settings: RegistrationSettings,
) -> _System:
    """Match the points where they are now, and return the least squares of the 18 unknowns."""
    points = sweep.moved(turn, shift)
    placed = se3.transform(pose, points)
    index, squares = surface.nearest(placed, settings.threads)
    planes = surface.planes(index)
    near = squares < max(settings.max_distance_m, MATCH_KERNELS * kernel_m) ** 2
    if surface.one_sided:
        near &= planes[:, :3] @ pose[:3, 3] > planes[:, 3]
    matches = PlaneMatches.linearised(pose, points[near], planes[near])
    at_pose, distances = matches.rows.planes[:6].T, matches.distances
    turning, moving = (basis[near] for basis in sweep.bases)
    J = np.hstack(
        [
            at_pose,
            *(turning[:, i, None] * at_pose[:, :3] for i in range(2)),
            *(moving[:, i, None] * at_pose[:, 3:] for i in range(2)),
        ]
    )
    shares = kernel_m**2 / (kernel_m**2 + distances**2)
    weights = planes[near, 4] * shares**2
    variance = float(weights @ distances**2 / max(weights.sum(), 1e-12))
    cost = float((1 - shares).sum() + (~near).sum()) / len(points)
    return _System(
        (J * weights[:, None]).T @ J, (J * weights[:, None]).T @ distances, variance, float(near.mean()), cost
    )
