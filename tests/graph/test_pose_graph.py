"""PoseGraph against GTSAM, closed forms and invariants."""

from __future__ import annotations

import re
from typing import ClassVar

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.graph import PoseGraph
from hybridlio.graph.model.noise import Robust

SIGMAS = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])


def random_covariance(rng: np.random.Generator, size: int = 6) -> np.ndarray:
    root = rng.normal(size=(size, size)) * 0.05
    return root @ root.T + 1e-4 * np.eye(size)


def random_graph(rng: np.random.Generator, count: int = 12, dimension: int = 3, robust: str | None = None) -> PoseGraph:
    """Return a noisy chain with loops, full covariances, and a prior at pose 0."""
    tangent = np.zeros((count, 6))
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    size = 6 if dimension == 3 else 3
    tangent[:, used] = rng.normal(size=(count, size))
    poses = [np.eye(4)]
    for xi in tangent[1:]:
        poses.append(poses[-1] @ se3.exp(xi))
    graph = PoseGraph(dimension)
    graph.add_prior(0, poses[0], random_covariance(rng, size))
    pairs = [(k, k + 1) for k in range(count - 1)] + [(0, count - 1), (2, 7), (7, 3)]
    for i, j in pairs:
        noise = np.zeros(6)
        noise[used] = 0.05 * rng.normal(size=size)
        step = se3.between(poses[i], poses[j]) @ se3.exp(noise)
        graph.add_between(i, j, step, random_covariance(rng, size), robust=robust)
    return graph


def reference(graph: PoseGraph, start: np.ndarray) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the same graph in space built by hand in GTSAM, and its solution."""
    bare, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in graph.factors.values():
        x, y, z, *q = factor.measured
        T = gtsam.Pose3(gtsam.Rot3.Quaternion(q[3], *q[:3]), [x, y, z])
        noise = gtsam.noiseModel.Gaussian.Covariance(factor.noise.covariance)
        make = gtsam.PriorFactorPose3 if factor.kind == "prior" else gtsam.BetweenFactorPose3
        bare.add(make(*factor.keys, T, noise))
    for key, pose in zip(graph.keys, start, strict=True):
        values.insert(key, gtsam.Pose3(pose))
    return bare, gtsam.GaussNewtonOptimizer(bare, values).optimize()


def test_poses_errors_and_covariances_equal_gtsams(rng):
    graph = random_graph(rng)
    solution = graph.optimize(tolerance=1e-12)
    bare, values = reference(graph, solution.poses)
    for key in graph.keys:
        np.testing.assert_allclose(solution.pose(key), values.atPose3(key).matrix(), atol=1e-5)
    assert solution.error == pytest.approx(bare.error(values), rel=1e-6)
    assert solution.error <= solution.error_before
    assert solution.converged
    marginals = gtsam.Marginals(bare, values)
    for key in graph.keys:
        np.testing.assert_allclose(solution.covariance(key), marginals.marginalCovariance(key), rtol=1e-3, atol=1e-7)


def test_the_covariance_of_a_chain_is_the_compounded_one(rng):
    graph = PoseGraph()
    steps, covariances = se3.exp(rng.normal(size=(3, 6))), [random_covariance(rng) for _ in range(3)]
    prior = random_covariance(rng)
    graph.add_prior(0, se3.exp(rng.normal(size=6)), prior)
    for k in range(3):
        graph.add_between(k, k + 1, steps[k], covariances[k])
    solution = graph.optimize()
    relative = covariances[0]
    for k in (1, 2):
        relative = se3.compose_covariance(relative, steps[k], covariances[k])
    np.testing.assert_allclose(solution.relative_covariance(0, 3), relative, rtol=1e-6, atol=1e-10)
    there_and_back = se3.rotate_covariance(relative, steps[0] @ steps[1] @ steps[2])
    np.testing.assert_allclose(solution.relative_covariance(3, 0), there_and_back, rtol=1e-6, atol=1e-10)
    whole = se3.compose_covariance(prior, steps[0] @ steps[1] @ steps[2], relative)
    np.testing.assert_allclose(solution.covariance(3), whole, rtol=1e-6, atol=1e-10)
    assert solution.error == pytest.approx(0, abs=1e-12)


def test_a_planar_graph_equals_a_graph_in_space_confined_to_the_plane(rng):
    flat = random_graph(rng, dimension=2)
    space = PoseGraph()
    for factor in flat.factors.values():
        x, y, theta = factor.measured
        T, covariance = np.eye(4), np.diag([1e-8, 1e-8, 1.0, 1.0, 1.0, 1e-8])
        T[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
        T[:2, 3] = x, y
        covariance[2:5, 2:5] = factor.noise.covariance
        add = space.add_prior if factor.kind == "prior" else space.add_between
        add(*factor.keys, T, covariance)
    a, b = flat.optimize(), space.optimize()
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-4)
    assert a.error == pytest.approx(b.error, rel=1e-5)
    np.testing.assert_allclose(a.covariance(5), b.covariance(5)[2:5, 2:5], rtol=1e-3, atol=1e-6)
    between = a.relative_covariance(2, 9)
    np.testing.assert_allclose(between, b.relative_covariance(2, 9)[2:5, 2:5], rtol=1e-3, atol=1e-6)
    factor_id = next(n for n, f in flat.factors.items() if f.keys == (2, 7))
    np.testing.assert_allclose(a.residual(factor_id), b.residual(factor_id)[2:5], atol=1e-4)


@pytest.mark.parametrize("method", ["odometry", "spanning-tree", "chordal"])
def test_every_initialisation_leads_to_the_same_solution(rng, method):
    graph = random_graph(rng)
    best = graph.optimize(tolerance=1e-9)
    graph.initialise(method)
    np.testing.assert_allclose(graph.optimize(initial="given", tolerance=1e-9).poses, best.poses, atol=1e-4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_chordal_initialisation_of_a_noiseless_graph_is_exact(rng, dimension):
    graph = random_graph(rng, dimension=dimension)
    truth = graph.optimize().poses
    exact = PoseGraph(dimension)
    exact.add_prior(0, truth[0], sigmas=0.1)
    for factor in graph.factors.values():
        if factor.kind == "between":
            i, j = factor.keys
            exact.add_between(i, j, se3.between(truth[i], truth[j]), sigmas=0.1)
    exact.initialise("chordal")
    np.testing.assert_allclose([exact.initial(key) for key in exact.keys], truth, atol=1e-9)


def test_bad_initial_values_are_replaced_by_better_ones(rng):
    graph = random_graph(rng)
    best = graph.optimize()
    for key in graph.keys[1:]:
        graph.set_initial(key, se3.exp(3 * rng.normal(size=6)))
    solution = graph.optimize()
    assert solution.error == pytest.approx(best.error, rel=1e-6)


def test_chi2_is_the_squared_whitened_residual_and_sums_to_twice_the_error(rng):
    graph = random_graph(rng)
    solution = graph.optimize()
    for number, factor in graph.factors.items():
        residual = solution.residual(number)
        assert solution.chi2(number) == pytest.approx(residual @ factor.noise.information @ residual)
    assert sum(solution.all_chi2().values()) / 2 == pytest.approx(solution.error)
    i, j = graph.factors[3].keys
    measured = reference_pose(graph, 3)
    expected = se3.log(se3.between(measured, se3.between(solution.pose(i), solution.pose(j))))
    np.testing.assert_allclose(solution.residual(3), expected, atol=1e-9)


def reference_pose(graph: PoseGraph, number: int) -> np.ndarray:
    x, y, z, *q = graph.factors[number].measured
    return gtsam.Pose3(gtsam.Rot3.Quaternion(q[3], *q[:3]), [x, y, z]).matrix()


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "dcs"])
def test_a_robust_kernel_limits_the_effect_of_a_wrong_loop(rng, kernel):
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    step = se3.exp([0, 0, 0.1, 1, 0, 0])
    for k in range(10):
        graph.add_between(k, k + 1, step, sigmas=0.005)
    truth = graph.optimize().poses
    plain = graph.add_between(0, 10, np.eye(4), sigmas=0.005)
    bent = np.linalg.norm(graph.optimize().poses[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    graph.remove(plain)
    robust = graph.add_between(0, 10, np.eye(4), sigmas=0.005, robust=kernel)
    solution = graph.optimize()
    off = np.linalg.norm(solution.poses[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert bent > 3
    assert off < (1.5 if kernel == "huber" else 0.15)
    assert solution.weight(robust) < 0.1
    assert solution.weight(0) == 1
    assert solution.error < 0.1 * solution.chi2(robust) / 2


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "dcs"])
@pytest.mark.parametrize("norm", [0.5, 1.9, 2.1, 30.0])
def test_loss_and_weight_of_a_kernel_equal_gtsams(kernel, norm):
    name = {"huber": "Huber", "cauchy": "Cauchy", "geman-mcclure": "GemanMcClure", "dcs": "DCS"}[kernel]
    ours = Robust(kernel, 2.0)
    theirs = getattr(gtsam.noiseModel.mEstimator, name)(4.0 if kernel == "dcs" else 2.0)
    assert ours.loss(norm**2) == pytest.approx(2 * theirs.loss(norm))
    assert ours.weight(norm) == pytest.approx(theirs.weight(norm))


def test_removing_a_factor_restores_the_solution_without_it(rng):
    graph = random_graph(rng)
    before = graph.optimize()
    number = graph.add_between(1, 8, np.eye(4), sigmas=SIGMAS)
    changed = graph.optimize()
    graph.remove(number)
    assert changed.error > before.error + 1
    np.testing.assert_allclose(graph.optimize().poses, before.poses, atol=1e-9)
    assert number in changed.all_chi2()
    assert graph.add_between(1, 8, np.eye(4), sigmas=SIGMAS) != number


def test_sigmas_covariance_and_information_are_equivalent(rng):
    step, covariance = se3.exp(rng.normal(size=6)), np.diag(SIGMAS**2)
    found = []
    for noise in ({"sigmas": SIGMAS}, {"covariance": covariance}, {"information": np.linalg.inv(covariance)}):
        graph = PoseGraph()
        graph.add_pose(0, np.eye(4))
        graph.fix(0)
        graph.add_between(0, 1, step, **noise)
        found.append(graph.optimize().covariance(1))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[0], covariance, rtol=1e-6, atol=1e-9)


def test_robots_share_a_graph_with_keys_of_robot_and_index(rng):
    graph = PoseGraph()
    step = se3.exp([0, 0, 0.2, 1, 0, 0])
    graph.add_prior((0, 0), np.eye(4), sigmas=0.01)
    for k in range(4):
        graph.add_between((0, k), (0, k + 1), step, sigmas=0.1)
    graph.add_between((0, 4), (1, 0), step, sigmas=0.1)
    for k in range(4):
        graph.add_between((1, k), (1, k + 1), step, sigmas=0.1)
    expected = np.linalg.matrix_power(step, 9)
    np.testing.assert_allclose(graph.optimize().pose((1, 4)), expected, atol=1e-6)
    assert len(graph.components()) == 1


def test_parts_that_are_each_anchored_are_solved_together(rng):
    graph = random_graph(rng, count=9)
    graph.add_prior(100, np.eye(4), sigmas=0.1)
    graph.add_between(100, 101, se3.exp([0, 0, 1, 1, 0, 0]), sigmas=0.1)
    assert [len(part) for part in graph.components()] == [9, 2]
    np.testing.assert_allclose(graph.optimize().pose(101), se3.exp([0, 0, 1, 1, 0, 0]), atol=1e-6)


def test_progress_reports_a_falling_error(rng):
    reports: list[tuple[str, int, float]] = []
    graph = random_graph(rng)
    for key in graph.keys:
        graph.set_initial(key, np.eye(4))
    solution = graph.optimize(initial="given", progress=lambda *report: reports.append(report))
    errors = [error for _, _, error in reports]
    assert len(reports) == solution.iterations > 1
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == pytest.approx(solution.error)


class Poses:
    """Anything with keys and coordinates."""

    keys: ClassVar = [1, 99]
    coordinates = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], np.zeros(7)])


def test_start_from_takes_anything_with_keys_and_coordinates(rng):
    graph = random_graph(rng)
    graph.start_from(Poses())
    np.testing.assert_array_equal(graph.initial(1), se3.make(np.eye(3), [1.0, 2.0, 3.0]))
    assert graph.initial(2) is None
    assert 99 not in graph


def test_start_from_takes_a_solutions_poses(rng):
    graph = random_graph(rng)
    solution = graph.optimize()
    graph.start_from(solution)
    again = graph.optimize(initial="given")
    assert again.error_before == pytest.approx(solution.error, rel=1e-9)


def test_fixed_poses_stay_and_free_poses_lie_between_them():
    graph = PoseGraph()
    for key, x in ((0, 0.0), (4, 4.4)):
        graph.add_pose(key, se3.make(np.eye(3), [x, 0, 0]))
        graph.fix(key)
    for k in range(4):
        graph.add_between(k, k + 1, se3.make(np.eye(3), [1.0, 0, 0]), sigmas=0.1)
    for solver in ("batch", "gnc"):
        np.testing.assert_allclose(graph.optimize(solver).poses[[0, 1, 2, 3, 4], 0, 3].sum(), 11.0, atol=1e-4)
        np.testing.assert_allclose(graph.optimize(solver).pose(4)[:3, 3], [4.4, 0, 0], atol=1e-6)
    graph.unfix(4)
    np.testing.assert_allclose(graph.optimize().pose(4)[:3, 3], [4.0, 0, 0], atol=1e-6)


def test_a_fixed_pose_without_initial_value_is_refused():
    graph = PoseGraph()
    graph.add_pose(3)
    graph.fix(3)
    with pytest.raises(GraphError, match="pose 3 is fixed but has no initial value"):
        graph.optimize()


@pytest.mark.parametrize(("solver", "dimension"), [("batch", 3), ("gnc", 3), ("batch", 2)])
def test_every_backend_solves_a_straight_chain_of_5000_poses(rng, solver, dimension):
    graph, used = PoseGraph(dimension), slice(0, 6) if dimension == 3 else slice(2, 5)
    graph.add_prior(0, np.eye(4), sigmas=1e-6)
    step = se3.make(np.eye(3), [1.0, 0, 0])
    for k in range(4999):
        graph.add_between(k, k + 1, step, sigmas=([1e-4] * 3 + [1e-3] * 3)[used])
        off = np.zeros(6)
        off[used] = 0.01 * rng.normal(size=6)[used]
        graph.set_initial(k + 1, se3.make(np.eye(3), [k + 1.0, 0, 0]) @ se3.exp(off))
    solution = graph.optimize(solver, initial="given")
    np.testing.assert_allclose(solution.pose(4999)[:3, 3], [4999, 0, 0], atol=1e-3)
    # heading noise integrates to a lateral standard deviation of σ √(n³/3) at the far end
    lateral = solution.covariance(4999)[4, 4] if dimension == 3 else solution.covariance(4999)[2, 2]
    assert np.sqrt(lateral) == pytest.approx(1e-4 * np.sqrt(4999**3 / 3), rel=0.01)


def test_the_public_names_are_exactly_these():
    assert {name for name in dir(PoseGraph()) if not name.startswith("_")} == {
        *("dimension", "keys", "factors", "fixed", "origin", "components"),
        *("add_pose", "initial", "set_initial", "start_from", "fix", "unfix", "set_origin", "remove"),
        *("add_prior", "add_between", "add_imu", "add_velocity", "add_zero_velocity", "add_bias"),
        *("add_gps", "add_gps_geodetic", "add_attitude", "add_gravity"),
        *("landmarks", "add_landmark", "add_point_observation", "add_bearing_range", "add_range", "add_bearing"),
        *("add_factor", "add_gtsam_factor", "add_altitude", "add_heading", "add_body_velocity", "add_wheel_speed"),
        *("calibrations", "add_calibration", "add_sensor_step"),
        *("copy", "subgraph", "remove_pose", "marginalise", "merge", "set_measurement", "set_noise"),
        *("to_gtsam", "from_gtsam"),
        *("initialise", "optimize", "online", "load", "load_report", "save"),
    }


def test_the_package_lists_its_names():
    import hybridlio.graph

    classes = {"CalibrationEstimate", "LoadReport", "OnlineSolver", "PoseGraph", "Solution"}
    listed = {name for name in dir(hybridlio.graph) if not name.startswith("_")}
    assert listed == classes | {"CALIBRATION_KINDS", "KERNELS"}
    assert all(getattr(hybridlio.graph, name).__name__ == name for name in classes)


def test_repr_is_one_informative_line(rng):
    graph = random_graph(rng)
    graph.fix(0)
    assert repr(graph) == "<PoseGraph 3D: 12 poses, 1 fixed, 14 between-factors, 1 other factors>"
    solution = graph.optimize()
    pattern = r"<Solution: 12 poses, error [\d.e+]+ -> [\d.e+]+ in \d+ iterations, converged>"
    assert re.fullmatch(pattern, repr(solution))
    rejecting = graph.optimize("gnc")
    assert re.search(r"converged(, \d+ factors rejected)?>$", repr(rejecting))
