"""What a report is made of, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.ate_rpe import Association, align, associate
from hybridlio.evaluation.consistency import PoseConsistency
from hybridlio.evaluation.evaluate import Evaluation, Steps, associated_step_errors, evaluate


@dataclass(frozen=True, eq=False)
class ReportData:
    """A run, for its report. All but the name and the estimate may be left out, and what needs them is then too.

    Attributes:
        name: the sequence's.
        estimate: ``N`` poses, with covariances relative to the first where known.
        reference: the truth, at any rate.
        estimate_name: what legends call the estimate.
        others: more trajectories to show beside, such as the one before smoothing, or a peer's; by name.
        initial_poses, final_poses: ``(N-1, 4, 4)`` steps ``T_k_k1`` before and after looking at the scans.
        step_covariances: ``(N-1, 6, 6)`` of the final steps.
        timings_s: stage to ``(M,)`` seconds, one a scan, in the order in which the stages run.
        ok: ``(N-1,)``; False where a step is bridged because its scan could not be used.
        degenerate: ``(N-1,)``; True where the scan left a direction of the step unconstrained.
        first_scan: which of the recording's scans, counted from 0, the estimate's first pose belongs to.
        loops: ``(L, 2)`` rows of the estimate that loop closures join.
        facts: short lines for the head by label, such as the sources used.
        config: the configuration as YAML text.
        warnings: what a reader should know before trusting the figures.
    """

    name: str
    estimate: Trajectory
    reference: Trajectory | None = None
    estimate_name: str = "estimate"
    others: Mapping[str, Trajectory] = field(default_factory=dict)
    initial_poses: Array | None = None
    final_poses: Array | None = None
    step_covariances: Array | None = None
    timings_s: Mapping[str, Array] = field(default_factory=dict)
    ok: NDArray[np.bool_] | None = None
    degenerate: NDArray[np.bool_] | None = None
    first_scan: int = 0
    loops: NDArray[np.int64] | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    config: str = ""
    warnings: Sequence[str] = ()

    def __post_init__(self) -> None:
        steps = len(self.estimate) - 1
        per_step = {
            "initial_poses": (4, 4),
            "final_poses": (4, 4),
            "step_covariances": (6, 6),
            "ok": (),
            "degenerate": (),
        }
        for name, shape in per_step.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != (steps, *shape):
                raise DataError(
                    f"report: {name} must be {(steps, *shape)} for {steps + 1} poses, not {np.shape(value)}"
                )
        for stage, seconds in self.timings_s.items():
            if np.ndim(seconds) != 1 or not len(seconds) or not np.isfinite(seconds).all():
                raise DataError(f"report: the timing of {stage!r} must be a finite number of seconds for each scan")

    @property
    def period_s(self) -> float | None:
        """Median time between poses; None for a single one."""
        stamps = self.estimate.stamps_ns
        return float(np.median(np.diff(stamps)) / NS_PER_S) if len(stamps) > 1 else None


@dataclass(frozen=True, eq=False)
class DrawnPath:
    """A trajectory as drawn: in the reference's frame, laid on it at the first moment they share.

    Attributes:
        rows: ``(M,)`` the trajectory's rows that are drawn, those that the reference has too where there is one.
        positions_m: ``(M, 3)``.
        travelled_m, error_m: ``(M,)`` the reference's path length and the distance from it; empty without reference.
    """

    rows: NDArray[np.int64]
    positions_m: Array
    travelled_m: Array
    error_m: Array


@dataclass(frozen=True, eq=False)
class TimedConsistency:
    """Consistency, and the times ``(M,)`` in seconds since the first pose that its rows belong to."""

    times_s: Array
    consistency: PoseConsistency


@dataclass(frozen=True, eq=False)
class Findings:
    """What follows from a run's data; parts without the data they need are empty or None.

    Attributes:
        paths: every trajectory by name, the estimate first.
        evaluations: by name.
        step_errors: ``initial`` and ``final`` to times ``(M,)`` s and errors ``(M, 6)`` in rad and m.
        steps, poses: consistency of the final steps, and of the poses relative to the first.
        notes: why something that was asked for is missing.
    """

    paths: dict[str, DrawnPath]
    evaluations: dict[str, Evaluation]
    step_errors: dict[str, tuple[Array, Array]]
    steps: TimedConsistency | None
    poses: TimedConsistency | None
    notes: list[str]


def analyse(data: ReportData) -> Findings:
    """Evaluate what can be evaluated; what cannot is noted, not raised."""
    notes: list[str] = []
    steps = None
    if data.final_poses is not None and data.step_covariances is not None:
        steps = Steps(data.final_poses, data.step_covariances)
    paths, evaluations = {}, {}
    own: Association | None = None
    for name, trajectory in {data.estimate_name: data.estimate, **data.others}.items():
        both = _associate(data.reference, trajectory, name, notes)
        paths[name] = _path(trajectory, both)
        if both is not None and data.reference is not None:
            is_own = trajectory is data.estimate
            evaluations[name] = evaluate(data.reference, trajectory, steps=steps if is_own else None)
            notes += [f"{name}: {warning}" for warning in evaluations[name].warnings]
            own = both if is_own else own
    errors = _step_errors(data, own)
    judged = evaluations.get(data.estimate_name)
    timed_steps = timed_poses = None
    if judged is not None and judged.step_consistency is not None:
        timed_steps = TimedConsistency(errors["final"][0], judged.step_consistency)
    if judged is not None and own is not None and judged.pose_consistency is not None:
        timed_poses = TimedConsistency(data.estimate.times_s[own.estimate_rows[1:]], judged.pose_consistency)
    return Findings(paths, evaluations, errors, timed_steps, timed_poses, notes)


def _associate(reference: Trajectory | None, trajectory: Trajectory, name: str, notes: list[str]) -> Association | None:
    if reference is None:
        return None
    try:
        return associate(reference, trajectory)
    except DataError as error:
        notes.append(f"{name} is not compared with the reference: {error}")
        return None


def _path(trajectory: Trajectory, both: Association | None) -> DrawnPath:
    if both is None:
        return DrawnPath(np.arange(len(trajectory)), trajectory.from_first().poses[:, :3, 3], np.empty(0), np.empty(0))
    laid = align(both.reference, both.estimate, "first").poses
    true = both.reference.poses[:, :3, 3]
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1)))
    return DrawnPath(both.estimate_rows, laid[:, :3, 3], travelled, np.linalg.norm(laid[:, :3, 3] - true, axis=1))


def _step_errors(data: ReportData, own: Association | None) -> dict[str, tuple[Array, Array]]:
    out = {}
    for name, poses in (("initial", data.initial_poses), ("final", data.final_poses)):
        if poses is not None and own is not None:
            rows, errors = associated_step_errors(own, data.estimate, np.asarray(poses))
            if len(rows):
                out[name] = (data.estimate.times_s[rows + 1], errors)
    return out
