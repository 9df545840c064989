"""Consistency of covariances: the normalised estimation error squared (NEES) and its average (ANEES).

Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), §5.4.2. Errors of poses
are right perturbations ``Log(estimate⁻¹·truth)``, like the covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory

PROBABILITY = 0.95  # of the bounds; the usual two-sided level of the NEES test


@dataclass(frozen=True, eq=False)
class Anees:
    """The average NEES, divided by the dimension: 1 is consistent, more means that the covariances are too small.

    Attributes:
        value: the average; ``k`` for covariances that are ``k`` times too small.
        lower, upper: the interval that has the average with the given probability for correct covariances and
            independent errors. Errors of absolute poses are correlated, and leave it far more often.
        nees: ``(N,)`` the NEES of each sample, divided by the dimension.
        dimension: the dimension of an error.
    """

    value: float
    lower: float
    upper: float
    nees: Array
    dimension: int

    @property
    def consistent(self) -> bool:
        """Whether the average is within the bounds."""
        return self.lower <= self.value <= self.upper


@dataclass(frozen=True, eq=False)
class PoseConsistency:
    """ANEES of poses (6 dimensions), and of their rotations and positions alone (3 each).

    Attributes:
        pose, rotation, position: the averages.
        errors: ``(N, 6)`` in rad and m, rotation first.
        sigmas: ``(N, 6)`` standard deviations by the covariances.
    """

    pose: Anees
    rotation: Anees
    position: Anees
    errors: Array
    sigmas: Array


def anees(errors: Array, covariances: Array, probability: float = PROBABILITY) -> Anees:
    """Return the average NEES of errors ``(N, d)`` with covariances ``(N, d, d)``, and its χ² bounds.

    Raises:
        DataError: the shapes do not match, there is no row, or a row is not finite or not positive definite; names it.
    """
    errors, covariances = np.asarray(errors, np.float64), np.asarray(covariances, np.float64)
    if errors.ndim != 2 or not len(errors) or covariances.shape != (*errors.shape, errors.shape[1]):
        raise DataError(
            f"ANEES: expected (N, d) errors and (N, d, d) covariances, got {errors.shape}, {covariances.shape}"
        )
    nees = (_whiten(errors, covariances) ** 2).sum(axis=1) / errors.shape[1]
    lower, upper = bounds(len(errors), errors.shape[1], probability)
    return Anees(float(nees.mean()), lower, upper, nees, errors.shape[1])


def bounds(samples: int, dimension: int, probability: float = PROBABILITY) -> tuple[float, float]:
    """Return the interval that has the average NEES, divided by the dimension, with the given probability."""
    from scipy.stats import chi2  # loaded here, as it takes half a second

    freedom = samples * dimension
    tail = (1 - probability) / 2
    return float(chi2.ppf(tail, freedom) / freedom), float(chi2.ppf(1 - tail, freedom) / freedom)


def pose_consistency(errors: Array, covariances: Array) -> PoseConsistency:
    """Return the ANEES of pose errors ``(N, 6)``, rotation first, with covariances ``(N, 6, 6)``.

    Raises:
        DataError: see :func:`anees`.
    """
    errors, covariances = np.asarray(errors, np.float64), np.asarray(covariances, np.float64)
    return PoseConsistency(
        pose=anees(errors, covariances),
        rotation=anees(errors[:, :3], covariances[:, :3, :3]),
        position=anees(errors[:, 3:], covariances[:, 3:, 3:]),
        errors=errors,
        sigmas=np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
    )


def step_consistency(relative_poses: Array, covariances: Array, reference: Trajectory) -> PoseConsistency:
    """Return the consistency of the steps from each pose to the next.

    Args:
        relative_poses: ``(N-1, 4, 4)`` estimated ``T_k_k1``.
        covariances: ``(N-1, 6, 6)`` their covariances, rad² and m², rotation first.
        reference: ``N`` poses.

    Raises:
        DataError: see :func:`anees` and :func:`step_errors`.
    """
    return pose_consistency(step_errors(relative_poses, reference), covariances)


def step_errors(relative_poses: Array, reference: Trajectory) -> Array:
    """Return the errors ``(N-1, 6)`` (rad, m) of estimated steps ``(N-1, 4, 4)`` against ``N`` reference poses.

    Raises:
        DataError: the numbers do not match.
    """
    relative_poses = np.asarray(relative_poses, np.float64)
    if len(relative_poses) != len(reference) - 1:
        raise DataError(f"{len(relative_poses)} steps do not match {len(reference)} reference poses; give one fewer")
    true = se3.between(reference.poses[:-1], reference.poses[1:])
    return se3.log(se3.between(relative_poses, true))


def absolute_consistency(estimate: Trajectory, reference: Trajectory) -> PoseConsistency:
    """Return the consistency of the poses relative to the first, which has no error and is left out.

    Raises:
        DataError: the estimate has no covariances, or the numbers of poses differ; see also :func:`anees`.
    """
    if estimate.covariances is None or len(reference) != len(estimate):
        count = 0 if estimate.covariances is None else len(estimate)
        raise DataError(f"consistency: {count} covariances for {len(reference)} reference poses; give one per pose")
    errors = se3.log(se3.between(estimate.from_first().poses, reference.from_first().poses))
    return pose_consistency(errors[1:], estimate.covariances[1:])


def _whiten(errors: Array, covariances: Array) -> Array:
    finite = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    if not finite.all():
        raise DataError(f"ANEES: row {int(finite.argmin())}: the error or its covariance is not finite")
    try:
        roots = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        row = int(np.linalg.eigvalsh(covariances)[:, 0].argmin())
        raise DataError(f"ANEES: row {row}: the covariance is not positive definite") from None
    return np.asarray(np.linalg.solve(roots, errors[..., None])[..., 0])
