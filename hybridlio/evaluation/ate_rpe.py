"""Errors of a whole trajectory: association by time, absolute trajectory error (ATE) and relative pose error (RPE).

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
from hybridlio.core.trajectory import Trajectory

Alignment = Literal["se3", "sim3", "first", "none"]
DeltaUnit = Literal["frames", "seconds", "metres"]

MAX_DIFFERENCE_NS = NS_PER_S // 10
LEVER_M = 1.0
_SAME_MOMENT_NS = 1_000_000  # stamps in files are rounded, some to a microsecond, some to a millisecond


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of poses or of relative poses.

    Attributes:
        translation_m, rotation_rad: ``(M,)`` lengths of the error's translation and angle.
        rows: ``(M,)`` the pose, or the first pose of the pair, that each belongs to.
    """

    translation_m: Array
    rotation_rad: Array
    rows: NDArray[np.int64]

    @property
    def rmse_m(self) -> float:
        """Root mean square of the translations, in metres."""
        return float(np.sqrt(np.mean(self.translation_m**2)))

    @property
    def rmse_deg(self) -> float:
        """Root mean square of the angles, in degrees."""
        return float(np.degrees(np.sqrt(np.mean(self.rotation_rad**2))))


@dataclass(frozen=True, eq=False)
class Association:
    """Reference and estimate at the same moments.

    Attributes:
        reference, estimate: ``M`` poses each, with equal stamps.
        estimate_rows: ``(M,)`` the estimate's row at (or nearest to) each moment.
    """

    reference: Trajectory
    estimate: Trajectory
    estimate_rows: NDArray[np.int64]


def associate(reference: Trajectory, estimate: Trajectory, max_difference_ns: int = MAX_DIFFERENCE_NS) -> Association:
    """Bring reference and estimate to common stamps.

    The stamps kept are those of the trajectory with fewer poses a second (the estimate's, where equal); the other is
    interpolated on the geodesic between its neighbours there. A moment is left out where the other trajectory has no
    pose within ``max_difference_ns``, or has not begun or has ended. Covariances are those of the nearest pose.

    Raises:
        DataError: a trajectory of one pose, or fewer than two common moments; then with both spans of time.
    """
    for name, trajectory in (("reference", reference), ("estimate", estimate)):
        if len(trajectory) < 2:
            raise DataError(f"the {name} has {len(trajectory)} poses; a comparison needs two or more")
    if len(reference) == len(estimate) and (reference.stamps_ns == estimate.stamps_ns).all():
        return Association(reference, estimate, np.arange(len(estimate)))
    keep_reference = _period_ns(reference) > 1.5 * _period_ns(estimate)
    kept, other = (reference, estimate) if keep_reference else (estimate, reference)
    rows, nearest, resampled = _resample(other, kept.stamps_ns, max_difference_ns)
    if len(rows) < 2:
        raise DataError(
            f"only {len(rows)} poses of the same time: the reference lasts {_span(reference)}, the estimate "
            f"{_span(estimate)}; check that both count time from the same zero"
        )
    kept = select(kept, rows)
    if keep_reference:
        return Association(kept, resampled, nearest)
    return Association(resampled, kept, rows)


def select(trajectory: Trajectory, rows: NDArray[np.int64]) -> Trajectory:
    """The trajectory's poses at ``rows``, with their covariances."""
    covariances = None if trajectory.covariances is None else trajectory.covariances[rows]
    return Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows], covariances)


def align(reference: Trajectory, estimate: Trajectory, how: Alignment = "se3", lever_m: float = LEVER_M) -> Trajectory:
    """The estimate moved onto the reference as a whole.

    Args:
        reference, estimate: ``M`` poses each, of the same moments.
        how: ``se3`` for the rigid motion that brings the poses closest; ``sim3`` with a scale too; ``first`` so that
            the first poses agree; ``none``.
        lever_m: beside each position, points so far from it along the pose's axes are brought closest too. Over a
            path of many metres that changes nothing to speak of; but positions alone leave open how a straight path
            turns about itself, and how one at rest turns at all, and would let their noise decide. 0 is Umeyama's
            alignment of positions.

    Raises:
        DataError: the trajectories do not have as many poses each.
        ConfigError: ``how`` is none of the four.
        EstimationError: a scale is asked for and the estimate does not move.
    """
    _check_pairs(reference, estimate)
    if how not in get_args(Alignment):
        raise ConfigError(f"alignment {how!r} is unknown; choose one of {', '.join(get_args(Alignment))}")
    if how == "none":
        return estimate
    if how == "first":
        T = reference.poses[0] @ se3.inverse(estimate.poses[0])
        return Trajectory(estimate.stamps_ns, T @ estimate.poses, estimate.covariances)
    R, t, scale = _closest(reference, estimate, lever_m, with_scale=how == "sim3")
    scaled = se3.make(estimate.poses[:, :3, :3], scale * estimate.poses[:, :3, 3])
    return Trajectory(estimate.stamps_ns, se3.make(R, t) @ scaled, estimate.covariances)


def ate(reference: Trajectory, estimate: Trajectory, how: Alignment = "se3", lever_m: float = LEVER_M) -> PoseErrors:
    """Absolute trajectory error: how far each pose is from the reference once the whole is aligned.

    Args:
        reference, estimate: ``M`` poses each, of the same moments.
        how, lever_m: the alignment, see :func:`align`.

    Raises:
        DataError, ConfigError, EstimationError: as :func:`align`.
    """
    error = se3.between(align(reference, estimate, how, lever_m).poses, reference.poses)
    return _errors(error, np.arange(len(reference)))


def rpe(reference: Trajectory, estimate: Trajectory, delta: float = 1, unit: DeltaUnit = "frames") -> PoseErrors:
    """Relative pose error: how wrong the motion is from each pose to the one ``delta`` later.

    Args:
        reference, estimate: ``M`` poses each, of the same moments.
        delta: the distance between the poses compared, at every pose that has a partner.
        unit: of ``delta``: ``frames``, ``seconds``, or ``metres`` along the reference; the partner is the first pose
            that is at least so far.

    Raises:
        DataError: not as many poses each, or none has a partner.
        ConfigError: the unit is unknown, or delta is not positive.
    """
    _check_pairs(reference, estimate)
    first, last = _partners(reference, delta, unit)
    true, estimated = (se3.between(t.poses[first], t.poses[last]) for t in (reference, estimate))
    return _errors(se3.between(estimated, true), first)


def _partners(reference: Trajectory, delta: float, unit: DeltaUnit) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    if unit not in get_args(DeltaUnit) or not delta > 0:
        raise ConfigError(
            f"RPE over {delta} {unit!r}: delta must be positive, in one of {', '.join(get_args(DeltaUnit))}"
        )
    steps_m = np.linalg.norm(np.diff(reference.poses[:, :3, 3], axis=0), axis=1)
    at = {
        "frames": np.arange(len(reference), dtype=np.float64),
        "seconds": reference.times_s,
        "metres": np.concatenate([[0.0], np.cumsum(steps_m)]),
    }[unit]
    last = np.searchsorted(at, at + delta * (1 - 1e-9))  # a rounded sum must not miss the pose it means
    first = np.flatnonzero(last < len(reference))
    if not len(first):
        raise DataError(
            f"RPE over {delta} {unit}: the trajectory is shorter ({at[-1]:g} {unit}); choose a smaller delta"
        )
    return first, last[first]


def _closest(
    reference: Trajectory, estimate: Trajectory, lever_m: float, with_scale: bool
) -> tuple[Array, Array, float]:
    y, x = reference.poses[:, :3, 3], estimate.poses[:, :3, 3]
    y_mean, x_mean = y.mean(axis=0), x.mean(axis=0)
    cross = (y - y_mean).T @ (x - x_mean) / len(x)
    turns = (reference.poses[:, :3, :3] @ np.swapaxes(estimate.poses[:, :3, :3], 1, 2)).mean(axis=0)
    U, _, Vt = np.linalg.svd(cross + lever_m**2 * turns)
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


def _check_pairs(reference: Trajectory, estimate: Trajectory) -> None:
    if len(reference) != len(estimate) or len(reference) < 2:
        raise DataError(
            f"cannot compare {len(reference)} reference poses with {len(estimate)}: two or more of the same moments "
            "are needed; associate them by time before"
        )


def _resample(
    trajectory: Trajectory, stamps_ns: NDArray[np.int64], max_difference_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Trajectory]:
    """Which of the stamps the trajectory covers, its nearest rows there, and itself interpolated at those stamps."""
    known = trajectory.stamps_ns
    right = (
        np.clip(np.searchsorted(known, stamps_ns), 1, len(known) - 1) if len(known) > 1 else np.zeros_like(stamps_ns)
    )
    left = np.maximum(right - 1, 0)
    nearest = np.where(stamps_ns - known[left] < known[right] - stamps_ns, left, right)
    covered = (stamps_ns >= known[0] - _SAME_MOMENT_NS) & (stamps_ns <= known[-1] + _SAME_MOMENT_NS)
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
