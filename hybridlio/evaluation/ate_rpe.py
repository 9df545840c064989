"""Associate trajectories by time, and compute absolute trajectory error (ATE) and relative pose error (RPE).

ATE and RPE: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), §VI. Alignment: Umeyama,
"Least-squares estimation of transformation parameters between two point patterns" (PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.core.trajectory import Trajectory, travelled_m

Alignment = Literal["se3", "sim3", "first", "none"]
DeltaUnit = Literal["frames", "seconds", "metres"]

MAX_DIFFERENCE_NS = NS_PER_S // 10  # one period of a lidar at 10 Hz
LEVER_M = 1.0  # weighs 1 rad as 1 m: above the position noise of an estimate, far below the extent of a path
_STAMP_ROUNDING_NS = 1_000_000  # some files round stamps to a millisecond


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of poses or of relative poses.

    Attributes:
        translation_m, rotation_rad: ``(M,)`` length of the translation error, and angle of the rotation error.
        rows: ``(M,)`` index of the pose, or of the first pose of the pair.
    """

    translation_m: Array
    rotation_rad: Array
    rows: NDArray[np.int64]

    @property
    def rmse_m(self) -> float:
        """Root mean square translation error in metres."""
        return float(np.sqrt(np.mean(self.translation_m**2)))

    @property
    def rmse_deg(self) -> float:
        """Root mean square rotation error in degrees."""
        return float(np.degrees(np.sqrt(np.mean(self.rotation_rad**2))))


@dataclass(frozen=True, eq=False)
class Association:
    """Estimate and reference at the same times.

    Attributes:
        estimate, reference: ``M`` poses each, with equal stamps.
        estimate_rows: ``(M,)`` index of the estimate's pose at, or nearest to, each time.
    """

    estimate: Trajectory
    reference: Trajectory
    estimate_rows: NDArray[np.int64]


def associate(estimate: Trajectory, reference: Trajectory, max_difference_ns: int = MAX_DIFFERENCE_NS) -> Association:
    """Resample estimate and reference to common stamps.

    The stamps are those of the trajectory with fewer poses per second (of the estimate, if equal). The other trajectory
    is interpolated on the geodesic between neighbouring poses; its covariances are those of the nearest pose. A stamp
    is dropped if it is outside the other trajectory or farther than ``max_difference_ns`` from its poses.

    Raises:
        DataError: a trajectory has fewer than two poses, or fewer than two stamps remain.
    """
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if len(trajectory) < 2:
            raise DataError(f"the {name} has {counted(len(trajectory), 'pose')}; a comparison needs at least two")
    if len(reference) == len(estimate) and (reference.stamps_ns == estimate.stamps_ns).all():
        return Association(estimate, reference, np.arange(len(estimate)))
    keep_reference = _period_ns(reference) > 1.5 * _period_ns(estimate)
    kept, other = (reference, estimate) if keep_reference else (estimate, reference)
    rows, nearest, resampled = _resample(other, kept.stamps_ns, max_difference_ns)
    if len(rows) < 2:
        raise DataError(
            f"only {counted(len(rows), 'pose')} at common times: the reference is {_span(reference)}, the estimate "
            f"{_span(estimate)}; check that their stamps count from the same zero"
        )
    kept = select(kept, rows)
    if keep_reference:
        return Association(resampled, kept, nearest)
    return Association(kept, resampled, rows)


def select(trajectory: Trajectory, rows: NDArray[np.int64]) -> Trajectory:
    """Return the trajectory's poses at ``rows``, with their covariances."""
    covariances = None if trajectory.covariances is None else trajectory.covariances[rows]
    return Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows], covariances)


def align(estimate: Trajectory, reference: Trajectory, how: Alignment = "se3", lever_m: float = LEVER_M) -> Trajectory:
    """Return the estimate, aligned with the reference as a whole.

    Args:
        estimate, reference: ``M`` poses each, at the same times.
        how: ``se3`` for the least-squares rigid motion; ``sim3`` for one with a scale; ``first`` to align the first
            poses; ``none``.
        lever_m: besides each position, align the points at this distance along the pose's axes. Positions alone do
            not determine the rotation about a straight path, or any rotation of a trajectory at rest, and leave it to
            noise. Over a path of many metres the effect is negligible. 0 gives Umeyama's alignment of positions.

    Raises:
        DataError: the trajectories have different numbers of poses.
        ConfigError: ``how`` is unknown.
        EstimationError: a scale is to be estimated and the estimate does not move.
    """
    _check_pairs(estimate, reference)
    if how not in get_args(Alignment):
        raise ConfigError(f"unknown alignment {how!r}; choose one of {', '.join(get_args(Alignment))}")
    if how == "none":
        return estimate
    if how == "first":
        T = reference.poses[0] @ se3.inverse(estimate.poses[0])
        return Trajectory(estimate.stamps_ns, T @ estimate.poses, estimate.covariances)
    R, t, scale = _alignment(estimate, reference, lever_m, with_scale=how == "sim3")
    scaled = se3.make(estimate.poses[:, :3, :3], scale * estimate.poses[:, :3, 3])
    return Trajectory(estimate.stamps_ns, se3.make(R, t) @ scaled, estimate.covariances)


def ate(estimate: Trajectory, reference: Trajectory, how: Alignment = "se3", lever_m: float = LEVER_M) -> PoseErrors:
    """Return the absolute trajectory error: the error of each pose after alignment of the whole trajectory.

    Args:
        estimate, reference: ``M`` poses each, at the same times.
        how, lever_m: the alignment, see :func:`align`.

    Raises:
        DataError, ConfigError, EstimationError: see :func:`align`.
    """
    error = se3.between(align(estimate, reference, how, lever_m).poses, reference.poses)
    return _errors(error, np.arange(len(reference)))


def rpe(estimate: Trajectory, reference: Trajectory, delta: float = 1, unit: DeltaUnit = "frames") -> PoseErrors:
    """Return the relative pose error: the error of the motion from each pose to the first one at least ``delta`` later.

    Args:
        estimate, reference: ``M`` poses each, at the same times.
        delta: the distance between the two poses of a pair.
        unit: of ``delta``: ``frames``, ``seconds``, or ``metres`` along the reference.

    Raises:
        DataError: the trajectories have different numbers of poses, or are shorter than ``delta``.
        ConfigError: the unit is unknown, or ``delta`` is not positive.
    """
    _check_pairs(estimate, reference)
    first, last = _pairs(reference, delta, unit)
    true, estimated = (se3.between(t.poses[first], t.poses[last]) for t in (reference, estimate))
    return _errors(se3.between(estimated, true), first)


def _pairs(reference: Trajectory, delta: float, unit: DeltaUnit) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    if unit not in get_args(DeltaUnit) or not delta > 0:
        raise ConfigError(
            f"RPE over {delta} {unit!r}: delta must be positive, in one of {', '.join(get_args(DeltaUnit))}"
        )
    at = {
        "frames": np.arange(len(reference), dtype=np.float64),
        "seconds": reference.times_s,
        "metres": travelled_m(reference.poses[:, :3, 3]),
    }[unit]
    last = np.searchsorted(at, at + delta * (1 - 1e-9))  # tolerates the rounding of a sum
    first = np.flatnonzero(last < len(reference))
    if not len(first):
        raise DataError(
            f"RPE over {delta} {unit}: the trajectory is shorter ({at[-1]:g} {unit}); choose a smaller delta"
        )
    return first, last[first]


def _alignment(
    estimate: Trajectory, reference: Trajectory, lever_m: float, with_scale: bool
) -> tuple[Array, Array, float]:
    """Return rotation, translation and scale of the alignment: Umeyama's, with the lever's points (:func:`align`).

    Each pose adds ``lever_m² · R_reference · R_estimateᵀ`` to Umeyama's cross-covariance: that of its axes' end points.
    """
    y, x = reference.poses[:, :3, 3], estimate.poses[:, :3, 3]
    y_mean, x_mean = y.mean(axis=0), x.mean(axis=0)
    cross = (y - y_mean).T @ (x - x_mean) / len(x)
    rotations = (reference.poses[:, :3, :3] @ np.swapaxes(estimate.poses[:, :3, :3], 1, 2)).mean(axis=0)
    U, _, Vt = np.linalg.svd(cross + lever_m**2 * rotations)
    R = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    scale = 1.0
    if with_scale:
        variance = float(((x - x_mean) ** 2).sum() / len(x))
        if variance < 1e-12:
            raise EstimationError("sim3 alignment: the estimate does not move, so it has no scale; align with se3")
        scale = float((R * cross).sum() / variance)
    return np.asarray(R), np.asarray(y_mean - scale * R @ x_mean), scale


def _errors(error: Array, rows: NDArray[np.int64]) -> PoseErrors:
    angles = np.linalg.norm(se3.so3_log(error[:, :3, :3]), axis=1)
    return PoseErrors(np.linalg.norm(error[:, :3, 3], axis=1), angles, rows)


def _check_pairs(estimate: Trajectory, reference: Trajectory) -> None:
    if len(reference) != len(estimate) or len(reference) < 2:
        raise DataError(
            f"cannot compare {len(reference)} reference poses with {len(estimate)} estimated ones: both need the same "
            "number, at least two; associate them by time first"
        )


def _resample(
    trajectory: Trajectory, stamps_ns: NDArray[np.int64], max_difference_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Trajectory]:
    """Return the indices of the stamps that the trajectory covers, its nearest rows, and its poses at these stamps."""
    known = trajectory.stamps_ns
    right = (
        np.clip(np.searchsorted(known, stamps_ns), 1, len(known) - 1) if len(known) > 1 else np.zeros_like(stamps_ns)
    )
    left = np.maximum(right - 1, 0)
    nearest = np.where(stamps_ns - known[left] < known[right] - stamps_ns, left, right)
    covered = (stamps_ns >= known[0] - _STAMP_ROUNDING_NS) & (stamps_ns <= known[-1] + _STAMP_ROUNDING_NS)
    rows = np.flatnonzero(covered & (np.abs(known[nearest] - stamps_ns) <= max_difference_ns))
    left, right, nearest, at = left[rows], right[rows], nearest[rows], stamps_ns[rows]
    fraction = np.clip((at - known[left]) / np.maximum(known[right] - known[left], 1), 0.0, 1.0)
    poses = se3.interpolate(trajectory.poses[left], trajectory.poses[right], fraction)
    covariances = None if trajectory.covariances is None else trajectory.covariances[nearest]
    return rows, nearest, Trajectory(at, poses, covariances)


def _period_ns(trajectory: Trajectory) -> float:
    return float(np.median(np.diff(trajectory.stamps_ns)))


def _span(trajectory: Trajectory) -> str:
    start, end = trajectory.stamps_ns[[0, -1]] / NS_PER_S
    return f"from {start:.3f} to {end:.3f} s"
