"""Compute all metrics of an estimate in one call: drift, ATE, RPE and the consistency of its covariances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.ate_rpe import MAX_DIFFERENCE_NS, Association, associate, ate, rpe
from hybridlio.evaluation.consistency import PoseConsistency, absolute_consistency, pose_consistency
from hybridlio.evaluation.drift import KITTI_LENGTHS_M, Drift, DriftAverage, kitti_drift, lengths_for

_MAX_HEADING_DIFFERENCE_DEG = 20.0  # more than estimates err; camera and lidar axes are 90° apart


@dataclass(frozen=True, eq=False)
class Steps:
    """Relative poses from each pose of an estimate to the next.

    Attributes:
        poses: ``(N-1, 4, 4)`` ``T_k_k1``.
        covariances: ``(N-1, 6, 6)``, rad² and m², rotation first.
    """

    poses: Array
    covariances: Array


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The errors of an estimate against a reference; None marks metrics that could not be computed.

    Attributes:
        poses: number of poses compared.
        duration_s: time from the first to the last of them.
        length_m, estimate_length_m: path lengths of the reference and of the estimate.
        t_rel_percent, r_rel_deg_per_100m: KITTI drift over 100–800 m; None for a path under 100 m.
        chosen_lengths_m: other segment lengths, given or fitted to a short path; None if there are none.
        chosen_t_rel_percent, chosen_r_rel_deg_per_100m: drift over these lengths; not comparable with KITTI's.
        ate_m: root mean square position error after rigid alignment of the positions (Umeyama, as in evo).
        ate_deg: root mean square orientation error after :func:`~hybridlio.evaluation.ate_rpe.align`, which uses
            orientations too.
        rpe_m, rpe_deg: root mean square relative pose error from frame to frame.
        end_error_m: position error of the last pose, with the first poses aligned.
        anees_rotation, anees_position: ANEES of the poses relative to the first; 1 is consistent, more overconfident.
        step_anees_rotation, step_anees_position: ANEES of the steps from pose to pose.
        anees_bounds, step_anees_bounds: the 95 % interval of ANEES for consistent covariances and independent errors.
        segments, segments_by_speed: drift averaged by length and by speed, over the chosen lengths if KITTI's do not
            fit.
        warnings: reasons not to trust some of the metrics.
        drift, chosen_drift: the drift of every segment.
        pose_consistency, step_consistency: every error with its standard deviation; without the first pose.
    """

    poses: int
    duration_s: float
    length_m: float
    estimate_length_m: float
    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    chosen_lengths_m: tuple[float, ...] | None
    chosen_t_rel_percent: float | None
    chosen_r_rel_deg_per_100m: float | None
    ate_m: float
    ate_deg: float
    rpe_m: float
    rpe_deg: float
    end_error_m: float
    anees_rotation: float | None
    anees_position: float | None
    anees_bounds: tuple[float, float] | None
    step_anees_rotation: float | None
    step_anees_position: float | None
    step_anees_bounds: tuple[float, float] | None
    segments: list[DriftAverage]
    segments_by_speed: list[DriftAverage]
    warnings: list[str]
    drift: Drift = field(repr=False)
    chosen_drift: Drift | None = field(repr=False)
    pose_consistency: PoseConsistency | None = field(repr=False)
    step_consistency: PoseConsistency | None = field(repr=False)

    def to_json_dict(self) -> dict[str, Any]:
        """Return all attributes except the single segments and errors, as plain numbers, lists and None."""
        arrays = ("drift", "chosen_drift", "pose_consistency", "step_consistency")
        out = {name: value for name, value in vars(self).items() if name not in arrays}
        for name, key in (("segments", "length_m"), ("segments_by_speed", "speed_m_s")):
            out[name] = [{key if k == "at" else k: v for k, v in asdict(average).items()} for average in out[name]]
        return {name: list(value) if isinstance(value, tuple) else value for name, value in out.items()}


def evaluate(
    estimate: Trajectory,
    reference: Trajectory | None,
    lengths_m: Sequence[float] | None = None,
    steps: Steps | None = None,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> Evaluation:
    """Compare an estimate with a reference.

    Args:
        estimate: poses of the same sensor as the reference's; its world frame may differ. If it has covariances, of the
            poses relative to the first, their consistency is computed.
        reference: the ground truth; None raises an error, as for a recording without a reference.
        lengths_m: segment lengths for drift in addition to KITTI's; default: those of
            :func:`~hybridlio.evaluation.drift.lengths_for` for a path under 100 m, otherwise none.
        steps: the estimate's relative poses, to compute the consistency of their covariances.
        max_difference_ns: see :func:`~hybridlio.evaluation.ate_rpe.associate`.

    Raises:
        DataError: there is no reference, an argument is no trajectory, fewer than two poses can be associated, or the
            numbers of steps and poses do not match.
    """
    _check_steps(steps, _require(estimate, "estimate"))
    both = associate(estimate, _require(reference, "reference"), max_difference_ns)
    drift = kitti_drift(both.estimate, both.reference)
    chosen = _chosen_drift(both, lengths_m, bool(len(drift)))
    shown = drift if len(drift) or chosen is None else chosen
    absolute, relative = ate(both.estimate, both.reference), rpe(both.estimate, both.reference)
    warnings = [*_order_warnings(both), *_axis_warnings(both)]
    poses = _consistency_or_none(lambda: _absolute(both), "poses", warnings)
    step = _consistency_or_none(lambda: _steps(both, estimate, steps), "steps", warnings)
    return Evaluation(
        poses=len(both.reference),
        duration_s=float((both.reference.stamps_ns[-1] - both.reference.stamps_ns[0]) / NS_PER_S),
        length_m=both.reference.length_m,
        estimate_length_m=both.estimate.length_m,
        t_rel_percent=drift.t_rel_percent,
        r_rel_deg_per_100m=drift.r_rel_deg_per_100m,
        chosen_lengths_m=chosen.lengths_m if chosen else None,
        chosen_t_rel_percent=chosen.t_rel_percent if chosen else None,
        chosen_r_rel_deg_per_100m=chosen.r_rel_deg_per_100m if chosen else None,
        ate_m=ate(both.estimate, both.reference, lever_m=0.0).rmse_m,
        ate_deg=absolute.rmse_deg,
        rpe_m=relative.rmse_m,
        rpe_deg=relative.rmse_deg,
        end_error_m=_end_error_m(both),
        anees_rotation=poses.rotation.value if poses else None,
        anees_position=poses.position.value if poses else None,
        anees_bounds=(poses.rotation.lower, poses.rotation.upper) if poses else None,
        step_anees_rotation=step.rotation.value if step else None,
        step_anees_position=step.position.value if step else None,
        step_anees_bounds=(step.rotation.lower, step.rotation.upper) if step else None,
        segments=shown.by_length(),
        segments_by_speed=shown.by_speed(),
        warnings=warnings,
        drift=drift,
        chosen_drift=chosen,
        pose_consistency=poses,
        step_consistency=step,
    )


def _require(trajectory: Trajectory | None, name: str) -> Trajectory:
    if trajectory is None:
        raise DataError(f"no {name} to compare with: the recording has none")
    if not isinstance(trajectory, Trajectory):
        raise DataError(
            f"the {name} is a {type(trajectory).__name__}; give a Trajectory, for a file Trajectory.load(path)"
        )
    return trajectory


def _check_steps(steps: Steps | None, estimate: Trajectory) -> None:
    if steps is not None and not len(steps.poses) == len(steps.covariances) == len(estimate) - 1:
        raise DataError(
            f"{len(steps.poses)} steps with {len(steps.covariances)} covariances do not match {len(estimate)} poses; "
            "there must be one fewer than poses"
        )


def _end_error_m(both: Association) -> float:
    end = se3.between(both.reference.from_first().poses[-1], both.estimate.from_first().poses[-1])
    return float(np.linalg.norm(end[:3, 3]))


def _order_warnings(both: Association) -> list[str]:
    """Return a warning if the arguments look swapped: ground truth has no covariances, odometry's estimates do."""
    if both.reference.covariances is None or both.estimate.covariances is not None:
        return []
    return [
        "the reference has covariances and the estimate has none: the estimate comes first, evaluate(estimate, "
        "reference), and only the covariances of the estimate are tested"
    ]


def _axis_warnings(both: Association) -> list[str]:
    """Return a warning if estimate and reference are poses of different sensors, such as camera and lidar.

    Such trajectories align well as a whole, but their relative errors are meaningless. They show in the mean direction
    of motion, which the axes of one sensor see alike.
    """
    steps = [se3.between(t.poses[:-1], t.poses[1:])[:, :3, 3] for t in (both.reference, both.estimate)]
    ahead = [step.sum(axis=0) for step in steps]
    lengths = [float(np.linalg.norm(direction)) for direction in ahead]
    if min(lengths) < 0.5 * both.reference.length_m or min(lengths) < 1.0:
        return []
    angle = np.degrees(np.arccos(np.clip(ahead[0] @ ahead[1] / (lengths[0] * lengths[1]), -1.0, 1.0)))
    if angle < _MAX_HEADING_DIFFERENCE_DEG:
        return []
    towards = ["xyz"[int(np.abs(direction).argmax())] for direction in ahead]
    return [
        f"the reference moves along its {towards[0]} axis, the estimate along its {towards[1]} axis, {angle:.0f}° off; "
        "if their poses are of different sensors (camera and lidar?), drift and relative errors are meaningless"
    ]


def _chosen_drift(both: Association, lengths_m: Sequence[float] | None, has_kitti_drift: bool) -> Drift | None:
    if lengths_m is not None:
        return kitti_drift(both.estimate, both.reference, lengths_m, step=1)
    lengths = () if has_kitti_drift else lengths_for(min(both.reference.length_m, KITTI_LENGTHS_M[0]))
    return kitti_drift(both.estimate, both.reference, lengths, step=1) if lengths else None


def _consistency_or_none(
    compute: Callable[[], PoseConsistency | None], name: str, warnings: list[str]
) -> PoseConsistency | None:
    # an invalid covariance must not lose drift and ATE
    try:
        return compute()
    except DataError as error:
        warnings.append(f"no consistency of the {name}: {error}")
        return None


def _absolute(both: Association) -> PoseConsistency | None:
    # covariances are relative to the estimate's first pose, so the reference must have that pose too
    if both.estimate.covariances is None or both.estimate_rows[0] != 0:
        return None
    return absolute_consistency(both.estimate, both.reference)


def _steps(both: Association, estimate: Trajectory, steps: Steps | None) -> PoseConsistency | None:
    if steps is None:
        return None
    rows, errors = associated_step_errors(both, estimate, steps.poses)
    return pose_consistency(errors, steps.covariances[rows]) if len(rows) else None


def associated_step_errors(
    both: Association, estimate: Trajectory, step_poses: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return the steps of which the reference has both ends, as indices ``(M,)``, and their errors ``(M, 6)``.

    Args:
        both: the estimate associated with the reference.
        estimate: the whole estimate, ``N`` poses.
        step_poses: ``(N-1, 4, 4)`` its relative poses ``T_k_k1``.
    """
    rows = both.estimate_rows
    at_own_stamps = estimate.stamps_ns[rows] == both.reference.stamps_ns
    pairs = np.flatnonzero((np.diff(rows) == 1) & at_own_stamps[:-1] & at_own_stamps[1:])
    true = se3.between(both.reference.poses[pairs], both.reference.poses[pairs + 1])
    return rows[pairs], se3.log(se3.between(step_poses[rows[pairs]], true))
