"""The motion through several scans at once: the one under which their points make the thinnest surfaces together.

One scan of a lidar that does not repeat its pattern is a bad surface: neighbours lie on one arc, and planes through
them lean. A second scan fits it nearly as well metres away as where it was. Three or more scans together have one clear
minimum, which attracts from afar.

The motion is smooth: relative to a *base* motion, such as the IMU's from rest, the lidar turns at a constant rate ``ω``
and moves with a velocity ``v`` and an acceleration ``a``. A point ``x`` measured at time ``t``, with the lidar at
``c``, is displaced to

    ``x(t) = Exp(t·ω)·(x − c) + c + t·v + t²/2·a``.

With an IMU, ``a`` is the error of gravity and ``ω`` the bias of the gyroscope, and their priors are narrow. Each point
is matched to a plane through its nearest neighbours among the points of *other* scans. Unlike in registration both
sides move, so the residual's derivative is that of the point less the mean of its neighbours':

    ``r = nᵀ(xᵢ − x̄)``,  ``∂r/∂ω = (tᵢ·yᵢ − \\overline{t·y}) × n``,  ``∂r/∂v = n·(tᵢ − t̄)``,
    ``∂r/∂a = n·(tᵢ² − \\overline{t²})/2``  with  ``y = x − c``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridlio.cloud.kd_tree import build_tree, threads_for
from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.registration.information import NORMAL_NOISE_WEIGHTED
from hybridlio.registration.settings import RegistrationSettings

SIZE = 9  # of a motion: rate of turn, velocity, acceleration
# Of the nearest points, those of other scans are used. Of two scans half the neighbours are of the other one.
_NEAREST = 18
_CONVERGED_M = 5e-3  # at the last scan; a fifth of the noise of a range, and far below the step of a wrong hypothesis
_CONVERGED_RAD = 1e-3
_HALF_WEIGHT_THICKNESS_M = 0.15  # as in hybridlio/cloud/plane_fitting.py
_NOT_MATCHED = 1.0  # the cost of a point without enough neighbours of other scans, that of a point far off its plane


@dataclass(frozen=True, eq=False)
class JointPoints:
    """Points of several scans, placed by the base motion in the frame of the first scan.

    Attributes:
        points: ``(N, 3)`` metres.
        centres: ``(N, 3)`` where the lidar was when it measured them.
        times_s: ``(N,)`` since the first scan's stamp.
        scans: ``(N,)`` number of the scan.
    """

    points: Array
    centres: Array
    times_s: Array
    scans: Index

    @classmethod
    def concatenate(cls, parts: Sequence[JointPoints]) -> JointPoints:
        """Return the points of all parts."""
        columns = zip(*((p.points, p.centres, p.times_s, p.scans) for p in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def moved(self, motion: Array) -> Array:
        """Return the points ``(N, 3)`` where a motion ``(9,)`` of rate, velocity, acceleration displaces them."""
        t = self.times_s[:, None]
        turned = np.einsum("nij,nj->ni", se3.so3_exp(t * motion[:3]), self.points - self.centres)
        return np.asarray(turned + self.centres + t * motion[3:6] + t**2 / 2 * motion[6:])


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A motion that is a minimum of the cost.

    Attributes:
        motion: ``(9,)`` rate of turn (rad/s), velocity (m/s) and acceleration (m/s²) beside the base motion.
        covariance: ``(9, 9)`` of it.
        costs: ``(M,)`` robust cost of each judged point, between 0 and 1.
        matched: share of the judged points with a plane.
    """

    motion: Array
    covariance: Array
    costs: Array
    matched: float

    def rise_over_scatter(self, lowest: JointMotion) -> float:
        """Return by how much the cost is above that of another motion, in standard deviations for independent points.

        See :mod:`hybridlio.registration.cost_profile`.
        """
        rises = self.costs - lowest.costs
        return float(rises.sum() / np.sqrt(rises @ rises + 1e-12))


@dataclass(frozen=True, eq=False)
class JointProblem:
    """What is minimised.

    Attributes:
        points: of all scans.
        settings: kernel, greatest distance of a match, threads.
        prior_sigmas: ``(9,)`` of a motion about zero.
        scale: ratio of the covariance to that of independent residuals.
        stride: one of this number of points is judged; planes are made of all.
    """

    points: JointPoints
    settings: RegistrationSettings
    prior_sigmas: Array
    scale: float
    stride: int = 1

    def solve(self, start: Array, kernel_start_m: float, iterations: int) -> JointMotion:
        """Return the minimum that Gauss-Newton steps from a motion ``(9,)`` lead to.

        Args:
            start: a motion.
            kernel_start_m: width of the first kernel, which is halved at every step.
            iterations: most steps.
        """
        settings, motion, kernel_m = self.settings, np.asarray(start, np.float64), kernel_start_m
        last_s = float(self.points.times_s.max())
        prior = np.diag(1 / self.prior_sigmas**2)
        for _ in range(iterations):
            is_narrow, kernel_m = kernel_m <= settings.kernel_m, max(kernel_m, settings.kernel_m)
            system = self._system(motion, kernel_m)
            information = system.hessian / system.variance_m2(self.scale)
            pull = system.gradient / system.variance_m2(self.scale) + prior @ motion
            step = -np.linalg.solve(information + prior, pull)
            motion, kernel_m = motion + step, kernel_m / 2
            shift_m, turn_rad = np.abs(step[3:6]).max() * last_s, np.abs(step[:3]).max() * last_s
            if is_narrow and shift_m < _CONVERGED_M and turn_rad < _CONVERGED_RAD:
                break
        system = self._system(motion, settings.kernel_m)
        information = system.corrected_hessian / system.variance_m2(self.scale)
        covariance = np.linalg.inv(information + prior)
        return JointMotion(motion, (covariance + covariance.T) / 2, system.costs, system.matched)

    def cost(self, motion: Array, kernel_m: float) -> float:
        """Return the mean robust cost of the judged points at a motion ``(9,)``, between 0 and 1."""
        return float(self._system(motion, kernel_m).costs.mean())

    def with_stride(self, stride: int) -> JointProblem:
        """Return the problem with fewer or more of its points judged."""
        return replace(self, stride=stride)

    def _system(self, motion: Array, kernel_m: float) -> _System:
        """Match points to planes of other scans' points, and linearise."""
        moved, settings = self.points.moved(motion), self.settings
        judged = np.arange(0, len(moved), self.stride)
        tree = build_tree(moved, settings.threads)
        threads = threads_for(len(judged), settings.threads)
        nearest, squares = tree.batch_knn_search(moved[judged], min(_NEAREST, len(moved)), num_threads=threads)
        nearest = np.minimum(nearest.astype(np.int64), len(moved) - 1)
        is_other = self.points.scans[nearest] != self.points.scans[judged, None]
        is_near = is_other & (squares < settings.max_distance_m**2)
        has_plane = is_near.sum(axis=1) >= MIN_NEIGHBOURS
        rows, near = judged[has_plane], nearest[has_plane]
        share = is_near[has_plane] / is_near[has_plane].sum(axis=1, keepdims=True)

        def beside(values: Array) -> Array:
            """Each point's value less the mean of its neighbours'."""
            return np.asarray(values[rows] - np.einsum("nk,nk...->n...", share, values[near]))

        mean = np.einsum("nk,nki->ni", share, moved[near])
        normals, weights = _planes(moved[near] - mean[:, None], share)
        t = self.points.times_s
        arms = moved - self.points.centres - t[:, None] * motion[3:6] - t[:, None] ** 2 / 2 * motion[6:]
        jacobian = np.column_stack(
            [
                np.cross(beside(t[:, None] * arms), normals),
                normals * beside(t)[:, None],
                normals * beside(t**2 / 2)[:, None],
            ]
        )
        distances = np.einsum("ni,ni->n", normals, moved[rows] - mean)
        costs = np.full(len(judged), _NOT_MATCHED)
        costs[has_plane] = distances**2 / (kernel_m**2 + distances**2)
        robust = weights * (kernel_m**2 / (kernel_m**2 + distances**2)) ** 2
        return _System(jacobian, distances, robust, costs, self.stride)


@dataclass(frozen=True, eq=False)
class _System:
    """The linearised matches: ``(M, 9)`` derivatives, ``(M,)`` distances, weights and costs of all judged points."""

    jacobian: Array
    distances: Array
    weights: Array
    costs: Array
    stride: int

    @property
    def hessian(self) -> Array:
        return np.asarray((self.jacobian * self.weights[:, None]).T @ self.jacobian)

    @property
    def gradient(self) -> Array:
        return np.asarray((self.jacobian * self.weights[:, None]).T @ self.distances)

    @property
    def corrected_hessian(self) -> Array:
        """Without the spurious share of noisy normals, see :mod:`hybridlio.registration.information`."""
        hessian, noise = self.hessian, np.zeros((SIZE, SIZE))
        for block in (slice(0, 3), slice(3, 6), slice(6, 9)):
            noise[block, block] = NORMAL_NOISE_WEIGHTED.mean * np.trace(hessian[block, block]) * np.eye(3)
        values, vectors = np.linalg.eigh(hessian - noise)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    @property
    def matched(self) -> float:
        return len(self.distances) / max(len(self.costs), 1)

    def variance_m2(self, scale: float) -> float:
        """Return the variance of a distance, times the ratio to independent ones, as if all points were judged."""
        squares = float(self.weights @ self.distances**2) / max(float(self.weights.sum()), 1e-12)
        return scale * max(squares, 1e-6) / self.stride


def _planes(centred: Array, share: Array) -> tuple[Array, Array]:
    """Return unit normals ``(M, 3)`` and weights ``(M,)`` of planes through points ``(M, K, 3)`` about their mean."""
    scatter = np.einsum("nk,nki,nkj->nij", share, centred, centred)
    eigenvalues, axes = np.linalg.eigh(scatter)
    thickness2 = np.maximum(eigenvalues[:, 0], 0.0)
    return axes[:, :, 0], _HALF_WEIGHT_THICKNESS_M**2 / (_HALF_WEIGHT_THICKNESS_M**2 + thickness2)
