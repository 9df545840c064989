import inspect
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory, read_pair
from hybridlio.evaluation import consistency
from hybridlio.evaluation.ate_rpe import align, associate, ate, rpe
from hybridlio.evaluation.drift import kitti_drift
from hybridlio.evaluation.evaluate import Evaluation, Steps, evaluate
from hybridlio.evaluation.metrics_table import format_metrics, metrics_table

STEP_COVARIANCE = np.diag([1e-4, 1e-4, 4e-4, 1e-4, 1e-4, 4e-4])


def drive(rng: np.random.Generator, n: int, speed_m: float = 1.0) -> tuple[Trajectory, Trajectory, Steps]:
    """Return a winding reference, an estimate with step errors of known covariance, and its steps."""
    bends = np.cumsum(rng.normal(0, [0.001, 0.001, 0.004], (n - 1, 3)), axis=0)
    true_steps = se3.exp(np.hstack([bends, np.tile([speed_m, 0, 0], (n - 1, 1))]))
    errors = rng.normal(size=(n - 1, 6)) * np.sqrt(np.diag(STEP_COVARIANCE))
    steps = true_steps @ se3.exp(errors)
    reference, poses, covariances = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
    for true_step, step in zip(true_steps, steps, strict=True):
        reference.append(reference[-1] @ true_step)
        poses.append(poses[-1] @ step)
        covariances.append(se3.compose_covariance(covariances[-1], step, STEP_COVARIANCE))
    stamps = np.arange(n) * 100_000_000
    estimate = Trajectory(stamps, np.array(poses), np.array(covariances))
    return Trajectory(stamps, np.array(reference)), estimate, Steps(steps, np.tile(STEP_COVARIANCE, (n - 1, 1, 1)))


def rendered(evaluations: dict[str, Evaluation]) -> str:
    console = Console(width=400)
    with console.capture() as text:
        console.print(metrics_table(evaluations))
    return text.get()


def test_the_evaluation_agrees_with_the_single_metrics(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 600)
    result = evaluate(estimate, reference, steps=steps)
    assert result.t_rel_percent == kitti_drift(estimate, reference).t_rel_percent
    assert result.ate_m == ate(estimate, reference, lever_m=0.0).rmse_m
    assert result.rpe_deg == rpe(estimate, reference).rmse_deg
    assert result.length_m == pytest.approx(599, abs=0.5)
    assert result.step_anees_rotation == pytest.approx(1, abs=0.15)
    assert result.step_anees_position == pytest.approx(1, abs=0.15)
    assert result.anees_rotation == consistency.absolute_consistency(estimate, reference).rotation.value
    assert result.chosen_lengths_m is None
    assert [s.at for s in result.segments] == [100, 200, 300, 400, 500]


def test_an_estimate_equal_to_the_reference_has_zero_error(rng: np.random.Generator) -> None:
    reference, _, _ = drive(rng, 300)
    result = evaluate(Trajectory(reference.stamps_ns, se3.exp([0, 0, 1, 5, 5, 0]) @ reference.poses), reference)
    for name in ("t_rel_percent", "r_rel_deg_per_100m", "ate_m", "ate_deg", "rpe_m", "rpe_deg", "end_error_m"):
        assert getattr(result, name) == pytest.approx(0, abs=1e-5), name


def test_a_short_run_has_drift_over_fitting_lengths_instead_of_kittis(rng: np.random.Generator) -> None:
    reference, estimate, _ = drive(rng, 80)
    result = evaluate(estimate, reference)
    assert result.t_rel_percent is None
    assert result.r_rel_deg_per_100m is None
    assert result.chosen_lengths_m == (5, 10, 15, 20, 25, 30, 35, 40)
    assert result.chosen_t_rel_percent is not None
    assert [s.at for s in result.segments] == list(result.chosen_lengths_m)
    text = rendered({"short": result})
    assert "t_rel over 5–40 m [%]" in text
    assert "t_rel [%]" not in text


def test_given_lengths_are_evaluated_in_addition_to_kittis(rng: np.random.Generator) -> None:
    reference, estimate, _ = drive(rng, 300)
    result = evaluate(estimate, reference, lengths_m=(10, 20))
    own = kitti_drift(estimate, reference, (10, 20), step=1)
    assert result.chosen_t_rel_percent == own.t_rel_percent
    assert result.t_rel_percent == evaluate(estimate, reference).t_rel_percent


def test_a_vehicle_at_rest_is_evaluated_without_drift(rng: np.random.Generator) -> None:
    reference, estimate, _ = drive(rng, 20, speed_m=0.0)
    result = evaluate(estimate, reference)
    assert (result.t_rel_percent, result.chosen_lengths_m, result.segments) == (None, None, [])
    assert result.ate_m > 0
    json.dumps(result.to_json_dict(), allow_nan=False)


def test_the_json_has_all_metrics_as_plain_values(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 300)
    result = evaluate(estimate, reference, steps=steps)
    back = json.loads(json.dumps(result.to_json_dict(), allow_nan=False))
    for name in ("t_rel_percent", "r_rel_deg_per_100m", "ate_m", "ate_deg", "rpe_m", "rpe_deg", "length_m"):
        assert back[name] == getattr(result, name)
    assert back["segments"][0] == {
        "length_m": 100.0,
        "count": result.segments[0].count,
        "t_rel_percent": result.segments[0].t_rel_percent,
        "r_rel_deg_per_100m": result.segments[0].r_rel_deg_per_100m,
    }


def test_comparing_camera_with_lidar_poses_gives_a_warning(
    rng: np.random.Generator,
) -> None:
    reference, estimate, _ = drive(rng, 300)
    T_camera_lidar = se3.make([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0, -0.08, -0.27])
    camera = Trajectory(reference.stamps_ns, T_camera_lidar @ reference.poses @ se3.inverse(T_camera_lidar))
    assert "along its z axis, the estimate along its x axis" in evaluate(estimate, camera).warnings[0]
    assert evaluate(estimate, reference).warnings == []
    still, shaken, _ = drive(rng, 50, speed_m=0.0)
    assert evaluate(shaken, still).warnings == []


def test_steps_are_evaluated_only_where_the_reference_has_both_ends(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 300)
    rows = np.r_[0:100, 150:300]
    partial = Trajectory(reference.stamps_ns[rows], reference.poses[rows])
    result = evaluate(estimate, partial, steps=steps, max_difference_ns=10_000_000)
    assert result.poses == 250
    errors = consistency.step_errors(steps.poses, reference)[np.r_[0:99, 150:299]]
    expected = consistency.pose_consistency(errors, steps.covariances[: len(errors)])
    assert result.step_anees_position == pytest.approx(expected.position.value)


def test_covariances_are_not_evaluated_without_a_reference_for_the_first_pose(rng: np.random.Generator) -> None:
    reference, estimate, _ = drive(rng, 300)
    late = Trajectory(reference.stamps_ns[5:], reference.poses[5:])
    assert evaluate(estimate, late).anees_rotation is None
    assert evaluate(estimate, reference).anees_rotation is not None


def test_steps_that_do_not_match_the_estimate_are_an_error(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 30)
    with pytest.raises(DataError, match="28 steps with 29 covariances do not match 30 poses"):
        evaluate(estimate, reference, steps=Steps(steps.poses[1:], steps.covariances))


def test_an_invalid_covariance_does_not_affect_the_other_metrics(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 300)
    assert estimate.covariances is not None
    broken = Trajectory(estimate.stamps_ns, estimate.poses, -estimate.covariances)
    result = evaluate(broken, reference, steps=Steps(steps.poses, steps.covariances * np.nan))
    assert result.t_rel_percent == pytest.approx(evaluate(estimate, reference).t_rel_percent)
    assert result.anees_rotation is None
    assert result.step_anees_rotation is None
    assert "consistency of the poses: ANEES: row 298: the covariance is not positive definite" in result.warnings[0]
    assert "consistency of the steps: ANEES: row 0: " in result.warnings[1]


def test_the_table_has_a_row_per_metric_and_a_column_per_run(rng: np.random.Generator) -> None:
    reference, estimate, steps = drive(rng, 300)
    full, bare = evaluate(estimate, reference, steps=steps), evaluate(reference, reference)
    lines = rendered({"with": full, "without": bare}).splitlines()
    for heading, value in format_metrics(full).items():
        line = next(line for line in lines if heading in line)
        assert value in line
        # the reference has no covariances, so that some metrics are missing
        assert format_metrics(bare).get(heading, "–") in line


def test_evaluation_without_a_reference_is_an_error():
    path = Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(DataError, match="no reference to compare with"):
        evaluate(path, None)


def test_arguments_in_the_wrong_order_are_noticed(rng: np.random.Generator) -> None:
    reference, estimate, _ = drive(rng, 30)
    assert "evaluate(estimate, reference)" in evaluate(reference, estimate).warnings[0]
    assert evaluate(estimate, reference).warnings == evaluate(estimate, estimate).warnings == []


def test_evaluation_of_something_else_than_trajectories_is_an_error(rng: np.random.Generator) -> None:
    _, estimate, _ = drive(rng, 30)
    with pytest.raises(DataError, match=r"the estimate is a str; give a Trajectory, for a file Trajectory\.load"):
        evaluate("poses.txt", estimate)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="the reference is a ndarray"):
        evaluate(estimate, estimate.poses)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "compare", [evaluate, ate, rpe, align, associate, kitti_drift, read_pair, consistency.absolute_consistency]
)
def test_every_comparison_takes_the_estimate_first(compare: Callable[..., Any]) -> None:
    first, second = list(inspect.signature(compare).parameters)[:2]
    assert (first.removesuffix("_path"), second.removesuffix("_path")) == ("estimate", "reference")
