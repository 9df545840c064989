"""Results of registrations: how well points lie on a surface, and which weak directions are observed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.information import UNKNOWN_SIGMA_M, covariance_of

# Scans in a row that leave a direction unobserved, from which on that is taken for the scene. Most starts in rooms and
# streets have one, over the gaps between the rings of the only scan before.
LONG_ADRIFT = 2
_LEAST_COVERAGE = 0.3  # a surface that covers less of a scan says little about it


class Fit(NamedTuple):
    """How well points lie on a surface.

    Attributes:
        cost: mean robust cost over all points, between 0 and 1; unmatched points cost 1.
        matched: share of points with a neighbour within the matching distance.
    """

    cost: float
    matched: float

    @property
    def matched_cost(self) -> float:
        """Mean robust cost of the matched points alone."""
        return (self.cost - (1 - self.matched)) / max(self.matched, 1e-12)


@dataclass(frozen=True, eq=False)
class Registration:
    """Result of a registration.

    Attributes:
        pose: ``(4, 4)``; maps the scan's points to the surface's frame.
        hessian: ``(6, 6)`` of half the weighted squared residuals at the result, for a right perturbation. The
            information is ``hessian / σ²``.
        lever_arms_m: ``(3,)`` of the matched points about the scan's axes.
        sigma_m: robust standard deviation of the residuals.
        matched: share of points with a neighbour within the matching distance.
        cost: mean robust cost over all points, between 0 and 1; unmatched points cost 1.
        iterations: steps taken.
        converged: whether the last step was below the convergence limits.
    """

    pose: Array
    hessian: Array
    lever_arms_m: Array
    sigma_m: float
    matched: float
    cost: float
    iterations: int
    converged: bool

    @property
    def diagnostics(self) -> dict[str, float]:
        """Numbers that say how well it went, by name."""
        return {
            "matched": self.matched,
            "iterations": float(self.iterations),
            "converged": float(self.converged),
            "sigma_m": self.sigma_m,
            "cost": self.cost,
        }

    @property
    def fit(self) -> Fit:
        """How well the points lie on the surface at the result."""
        return Fit(self.cost, self.matched)

    def within_coverage(self, coverage: float) -> Registration:
        """Return the registration with its share of matches and its cost relative to the points that could match.

        Args:
            coverage: share of the scan's points that the surface covers, see
                :meth:`hybridlio.registration.local_map.LocalMap.covered`; values beyond the limits are taken for those.
        """
        coverage = min(max(coverage, _LEAST_COVERAGE), 1.0)
        matched = min(self.matched / coverage, 1.0)
        return replace(self, matched=matched, cost=max(1 - (1 - self.cost) / coverage, 0.0))


@dataclass(frozen=True, eq=False)
class ObservedRegistration:
    """A registration, and which of its weak directions are observed.

    Attributes:
        registration: along unobserved directions its pose is the initial one.
        weak_basis: ``(6, D)`` the weak directions, orthonormal in the units of
            :func:`hybridlio.registration.information.scaled_spectrum`; D is 0 in most scenes.
        weak_tangents: ``(D, 6)`` tangent vectors: change of the pose for each metre along a weak direction. Between
            curved walls it includes a rotation.
        is_observed: ``(D,)``.
        weak_sigmas_m: ``(D,)`` standard deviations along them, 10 m where unknown.
        normal_noise: spurious share of the surface's information.
        is_settled: the deviations of observed directions are those of independent residuals, to be scaled as those of
            strong directions are.
        adrift_m: how far off the pose may be along a direction in which scan after scan has left it unknown.
        disbelieved: ``(U, 6)`` unit tangent directions that seem observed and are taken for unobserved.
    """

    registration: Registration
    weak_basis: Array
    weak_tangents: Array
    is_observed: NDArray[np.bool_]
    weak_sigmas_m: Array
    normal_noise: float
    is_settled: bool = False
    adrift_m: float = 0.0
    disbelieved: Array = field(default_factory=lambda: np.empty((0, 6)))

    @property
    def degenerate(self) -> Array:
        """``(U, 6)`` unit tangent directions that are not observed."""
        unobserved = self.weak_tangents[~self.is_observed]
        return np.concatenate([unobserved / np.linalg.norm(unobserved, axis=1, keepdims=True), self.disbelieved])

    def within_coverage(self, coverage: float) -> ObservedRegistration:
        """As :meth:`hybridlio.registration.results.Registration.within_coverage`."""
        return replace(self, registration=self.registration.within_coverage(coverage))

    def adrift(self, times: int, disbelieved: Array) -> ObservedRegistration:
        """Return what is to be believed of the result where nothing else knows the position along a direction.

        From the second scan in a row on, three errors are shared with the scans before, and no number of scans averages
        them out. In tunnels they were taken for measurements of the speed, and positions became sure and wrong:

        * What little the costs depend on the position comes from the lidar's own pattern, at rest relative to it.
          Guesses with one error are worth one. With ``k(k + 1)/2`` times the variance of the ``k``-th, any number of
          them has at most twice the information of the first, as ``Σ 1/(k(k + 1)) = 1``.
        * Normals lean. Moved along the direction by an unknown way, points seem nearer to their planes or farther.
        * By chance one sparse scan in ten or twenty seems to observe the direction.

        Args:
            times: number of scans in a row that leave the direction unobserved.
            disbelieved: ``(U, 6)`` unit tangent directions that are not observed even if no direction seems unobserved.
        """
        if times < LONG_ADRIFT:
            return self
        factor = np.where(self.is_observed, 1.0, np.sqrt(times * (times + 1) / 2))
        disbelieved = self.disbelieved if len(self.degenerate) else disbelieved
        sigmas_m = factor * self.weak_sigmas_m
        return replace(self, weak_sigmas_m=sigmas_m, adrift_m=UNKNOWN_SIGMA_M, disbelieved=disbelieved)

    def covariance(self, scale: float) -> Array:
        """Return ``(6, 6)`` rad² and m², rotation first: from the Hessian in strong directions, from costs in weak
        ones.

        Args:
            scale: ratio of the strong directions' covariance to that of independent residuals.
        """
        found, noise = self.registration, self.normal_noise
        sigma_m = float(np.hypot(found.sigma_m, self.adrift_m * np.sqrt(noise)))  # of normals that lean as they do
        strong = covariance_of(found.hessian, sigma_m, scale, found.lever_arms_m, noise, fixed=self.weak_basis)
        sigmas_m = np.where(self.is_settled & self.is_observed, np.sqrt(scale), 1.0) * self.weak_sigmas_m
        weak = self.weak_tangents * np.minimum(sigmas_m, UNKNOWN_SIGMA_M)[:, None]
        return np.asarray(strong + weak.T @ weak + UNKNOWN_SIGMA_M**2 * self.disbelieved.T @ self.disbelieved)

    def weighed_with(self, start: Array, predicted: Array) -> tuple[Array, Array]:
        """Return the pose ``(4, 4)`` with its weak directions weighed with a prediction, and their covariance.

        Along a direction that few points observe, the cost's minimum scatters by centimetres from scan to scan, while
        an IMU knows a step to millimetres. As in a Kalman filter each counts by its information. Strong directions are
        left to the registration.

        Args:
            start: ``(4, 4)`` the predicted pose.
            predicted: ``(6, 6)`` its covariance relative to the surface.

        Returns:
            the registration's own pose and zeros where no direction is weak.
        """
        pose = self.registration.pose
        if not self.weak_basis.shape[1]:
            return pose, np.zeros((6, 6))
        from_tangent = np.r_[self.registration.lever_arms_m, 1.0, 1.0, 1.0]
        to_weak = (self.weak_basis * from_tangent[:, None]).T
        moved_m = to_weak @ se3.log(se3.between(start, pose))
        known = to_weak @ predicted @ to_weak.T
        gain = known @ np.linalg.inv(known + np.diag(self.weak_sigmas_m**2))
        remaining = known - gain @ known
        back = (gain @ moved_m - moved_m) @ self.weak_tangents
        return pose @ se3.exp(back), self.weak_tangents.T @ ((remaining + remaining.T) / 2) @ self.weak_tangents
