"""The input of a report, and its analysis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory, travelled_m
from hybridlio.evaluation.ate_rpe import Association, align, associate
from hybridlio.evaluation.consistency import PoseConsistency
from hybridlio.evaluation.evaluate import Evaluation, Steps, associated_step_errors, evaluate

DOUBTFUL = "doubtful: "  # how the notes of a recording begin that put it in doubt


@dataclass(frozen=True, eq=False)
class ReportData:
    """A run, for its report. Only the name and the estimate are required; parts without data are left out.

    Attributes:
        name: name of the sequence.
        estimate: ``N`` poses, with covariances relative to the first if known.
        reference: the ground truth, at any rate.
        estimate_name: name of the estimate in legends.
        others: other trajectories to show, by name, such as the one before smoothing.
        initial_poses, final_poses: ``(N-1, 4, 4)`` steps ``T_k_k1`` before and after the residual.
        step_covariances: ``(N-1, 6, 6)`` covariances of the final steps.
        timings_s: by stage, ``(M,)`` seconds per scan; stages in the order in which they run.
        ok: ``(N-1,)``; False where the scan could not be used and the step is bridged by the initial pose.
        degenerate: ``(N-1,)``; True where the scan does not constrain every direction of the step.
        conflicts: by verdict of the innovation gate, rows of the estimate whose scan conflicts with the IMU.
        map_points: ``(P, 3)`` points of the scans in the estimate's frame, to draw below the path.
        fixes_m: ``(F, 3)`` GPS fixes in the estimate's frame.
        fix_covariances_m2: ``(F, 3, 3)`` of these, in the same frame.
        fix_times_s: ``(F,)`` seconds of the fixes since the estimate's first pose.
        fix_residuals_m: ``(F, 3)`` antenna minus fix; east, north, up.
        biases: ``(N, 6)`` of accelerometer (m/s²) and gyroscope (rad/s); NaN where not known.
        bias_sigmas: ``(N, 6)`` standard deviations of these; NaN where not known.
        reference_doubts: why the reference contradicts itself or other sensors; figures that compare with it are then
            shown as doubtful.
        first_scan: index of the recording's scan that the first pose of the estimate belongs to.
        loops: ``(L, 2)`` rows of the estimate that loop closures connect.
        facts: short texts for the head by label, such as the sources used.
        config: the configuration as YAML text.
        warnings: what a reader should know first.
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
    conflicts: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    map_points: Array | None = None
    fixes_m: Array | None = None
    fix_covariances_m2: Array | None = None
    fix_times_s: Array | None = None
    fix_residuals_m: Array | None = None
    biases: Array | None = None
    bias_sigmas: Array | None = None
    reference_doubts: Sequence[str] = ()
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
                    f"report: {name} must have the shape {(steps, *shape)} for {steps + 1} poses, not {np.shape(value)}"
                )
        for stage, seconds in self.timings_s.items():
            if np.ndim(seconds) != 1 or not len(seconds) or not np.isfinite(seconds).all():
                raise DataError(f"report: timings_s[{stage!r}] must be one finite number of seconds per scan")

    @property
    def recording_doubts(self) -> list[str]:
        """The warnings that put the recording itself in doubt."""
        return [text.removeprefix(DOUBTFUL) for text in self.warnings if text.startswith(DOUBTFUL)]

    @property
    def flagged(self) -> dict[str, NDArray[np.int64]]:
        """Rows of the estimate by what is wrong with their scans, the gravest first."""
        steps = {"bridged": self.ok, "degenerate": self.degenerate}
        rows = {
            name: np.flatnonzero(np.asarray(flags, bool) != (name == "bridged")) + 1
            for name, flags in steps.items()
            if flags is not None
        }
        return {**rows, **self.conflicts}

    def times_s(self, trajectory: Trajectory) -> Array:
        """Return the times ``(N,)`` of another trajectory, in seconds since the first pose of the estimate."""
        since_ns: Array = trajectory.stamps_ns - self.estimate.stamps_ns[0]
        return since_ns / NS_PER_S

    @property
    def period_s(self) -> float | None:
        """Median time between poses; None for a single pose."""
        stamps = self.estimate.stamps_ns
        return float(np.median(np.diff(stamps)) / NS_PER_S) if len(stamps) > 1 else None


@dataclass(frozen=True, eq=False)
class DrawnPath:
    """A trajectory as drawn: in the reference's frame, aligned at the first common pose.

    Attributes:
        rows: ``(M,)`` the trajectory's rows that are drawn; with a reference, those that it has too.
        positions_m: ``(M, 3)`` positions.
        travelled_m, error_m: ``(M,)`` path length of the reference and distance from it; empty without a reference.
        aligned_error_m: ``(M,)`` the same after rigid alignment of all positions; empty without a reference.
        T_drawn_world: ``(4, 4)`` from the trajectory's own frame to that of the drawing.
    """

    rows: NDArray[np.int64]
    positions_m: Array
    travelled_m: Array
    error_m: Array
    aligned_error_m: Array
    T_drawn_world: Array


@dataclass(frozen=True, eq=False)
class TimedConsistency:
    """Consistency, and the times of its rows, ``(M,)`` seconds since the first pose."""

    times_s: Array
    consistency: PoseConsistency


@dataclass(frozen=True, eq=False)
class Findings:
    """The analysis of a run; parts without data are empty or None.

    Attributes:
        paths: all trajectories by name, the estimate first.
        evaluations: their evaluations by name.
        step_errors: for ``initial`` and ``final``, times ``(M,)`` in s and errors ``(M, 6)`` in rad and m.
        steps, poses: consistency of the final steps, and of the poses relative to the first.
        notes: warnings of the evaluations, and why a trajectory is not compared.
    """

    paths: dict[str, DrawnPath]
    evaluations: dict[str, Evaluation]
    step_errors: dict[str, tuple[Array, Array]]
    steps: TimedConsistency | None
    poses: TimedConsistency | None
    notes: list[str]


def analyse(data: ReportData) -> Findings:
    """Return the analysis of a run. A trajectory that cannot be compared with the reference is noted, not an error."""
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
            evaluations[name] = evaluate(trajectory, data.reference, steps=steps if is_own else None)
            notes += [f"{name}: {warning}" for warning in evaluations[name].warnings]
            own = both if is_own else own
    errors = _step_errors(data, own)
    evaluation = evaluations.get(data.estimate_name)
    timed_steps = timed_poses = None
    if evaluation is not None and evaluation.step_consistency is not None:
        timed_steps = TimedConsistency(errors["final"][0], evaluation.step_consistency)
    if evaluation is not None and own is not None and evaluation.pose_consistency is not None:
        timed_poses = TimedConsistency(data.estimate.times_s[own.estimate_rows[1:]], evaluation.pose_consistency)
    return Findings(paths, evaluations, errors, timed_steps, timed_poses, notes)


def _associate(reference: Trajectory | None, trajectory: Trajectory, name: str, notes: list[str]) -> Association | None:
    if reference is None:
        return None
    try:
        return associate(trajectory, reference)
    except DataError as error:
        notes.append(f"{name}: not compared with the reference: {error}")
        return None


def _path(trajectory: Trajectory, both: Association | None) -> DrawnPath:
    if both is None:
        none, T = np.empty(0), se3.inverse(trajectory.poses[0])
        return DrawnPath(np.arange(len(trajectory)), (T @ trajectory.poses)[:, :3, 3], none, none, none, T)
    true = both.reference.poses[:, :3, 3]
    at_start, as_whole = (align(both.estimate, both.reference, how).poses for how in ("first", "se3"))
    off, off_as_whole = (np.linalg.norm(poses[:, :3, 3] - true, axis=1) for poses in (at_start, as_whole))
    T = at_start[0] @ se3.inverse(both.estimate.poses[0])
    return DrawnPath(both.estimate_rows, at_start[:, :3, 3], travelled_m(true), off, off_as_whole, T)


def _step_errors(data: ReportData, own: Association | None) -> dict[str, tuple[Array, Array]]:
    out = {}
    for name, poses in (("initial", data.initial_poses), ("final", data.final_poses)):
        if poses is not None and own is not None:
            rows, errors = associated_step_errors(own, data.estimate, np.asarray(poses))
            if len(rows):
                out[name] = (data.estimate.times_s[rows + 1], errors)
    return out


def stretches(rows: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and the last of each run of consecutive numbers."""
    if not len(rows):
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]
