"""Calibration variables are found with honest uncertainty, say what is not determined, and travel with the graph."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from calibrated_rides import Truth, calibrated_graph

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import CALIBRATION_KINDS, PoseGraph

SIGMAS = {
    "rotation": 0.05, "translation": 0.2, "lidar_s": 0.005, "gps_s": 0.005, "antenna": 0.5, "scale": 0.05,
    "gravity": 0.05,
}  # fmt: skip
STEP = se3.exp([0, 0, 0.2, 1, 0.1, 0])


def stated() -> PoseGraph:
    graph = PoseGraph()
    lidar = np.r_[np.full(3, SIGMAS["rotation"]), np.full(3, SIGMAS["translation"])]
    graph.add_calibration("lidar", "extrinsics", sigmas=lidar)
    graph.add_calibration("lidar clock", "time_offset", sigmas=SIGMAS["lidar_s"])
    graph.add_calibration("GPS clock", "time_offset", sigmas=SIGMAS["gps_s"])
    graph.add_calibration("antenna", "lever_arm", sigmas=SIGMAS["antenna"])
    graph.add_calibration("wheels", "scale", sigmas=SIGMAS["scale"])
    graph.add_calibration("biases", "bias", sigmas=np.repeat([0.05, 0.005], 3))
    graph.add_calibration("gravity", "gravity", sigmas=SIGMAS["gravity"])
    return graph


def errors_of(solution, truth: Truth) -> dict[str, np.ndarray]:
    return {
        "lidar": se3.log(se3.inverse(solution.calibration("lidar").value) @ truth.T_body_lidar),
        "lidar clock": solution.calibration("lidar clock").change - truth.lidar_s,
        "GPS clock": solution.calibration("GPS clock").change - truth.gps_s,
        "antenna": solution.calibration("antenna").value - truth.antenna_m,
        "wheels": np.array([solution.calibration("wheels").value - truth.scale]),
        "biases": solution.calibration("biases").value - truth.bias,
        "gravity": solution.calibration("gravity").value - truth.gravity,
    }


def test_all_kinds_together_are_found_with_honest_covariances():
    normalised: dict[str, list[float]] = {}
    for seed in range(16):
        rng = np.random.default_rng(seed)
        truth = Truth.drawn(rng, SIGMAS)
        solution = calibrated_graph(rng, truth, stated(), 20).optimize()
        assert solution.converged
        assert 0.7 < 2 * solution.error / solution.degrees_of_freedom < 1.4
        for name, error in errors_of(solution, truth).items():
            covariance = solution.covariance(name)
            freedom = np.linalg.matrix_rank(covariance, tol=1e-14)
            squared = error @ np.linalg.pinv(covariance, rcond=1e-9) @ error
            normalised.setdefault(name, []).append(squared / freedom)
    means = {name: float(np.mean(values)) for name, values in normalised.items()}
    # the mean of 16 draws of one degree of freedom is 1 ± 0.35; a sigma wrong by a factor of two gives 0.25 or 4
    assert all(0.3 < mean < 2.2 for mean in means.values()), means


def test_the_calibration_makes_wrong_statements_harmless():
    rng = np.random.default_rng(3)
    truth = Truth.drawn(rng, SIGMAS)
    solution = calibrated_graph(rng, truth, stated(), 25).optimize()
    assert np.linalg.norm(errors_of(solution, truth)["antenna"]) < 0.2 * np.linalg.norm(truth.antenna_m)
    joint = solution.joint_covariance(["antenna", 5, "lidar clock"])
    assert joint.shape == (10, 10)
    np.testing.assert_allclose(joint[:3, :3], solution.covariance("antenna"), rtol=1e-6)
    np.testing.assert_allclose(joint[3:9, 3:9], solution.covariance(5), rtol=1e-6)


def driving(dimension: int, turning: bool) -> PoseGraph:
    """Return a graph of a level drive, straight or in bends, whose antenna and sensor are calibrated."""
    graph, T = PoseGraph(dimension), np.eye(4)
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    graph.add_calibration("antenna", "lever_arm", sigmas=1.0)
    graph.add_calibration("camera", "extrinsics", sigmas=0.3)
    graph.add_calibration("wheels", "scale", sigmas=0.1)
    K, arm = se3.exp([0, 0, 0.1, 0.2, -0.1, 0]), np.array([0.5, -0.3, 0])
    graph.add_prior(0, T, sigmas=1e-4)
    for k in range(30):
        step = se3.exp([0, 0, 0.3 * np.sin(0.7 * k) if turning else 0, 1, 0, 0])
        seen = se3.between(K, step @ K)
        seen[:3, 3] *= 1.1
        graph.add_sensor_step(k, k + 1, seen, ["camera", "wheels"], sigmas=(1e-3,) * len(range(6)[used]))
        T = T @ step
        graph.add_gps(k + 1, (T @ np.r_[arm, 1])[:dimension], 0.01, calibration="antenna")
    return graph


def test_bends_determine_a_planar_calibration():
    solution = driving(2, turning=True).optimize()
    assert all(solution.calibration(name).is_determined for name in solution.calibrations)
    assert solution.calibration("wheels").value == pytest.approx(1.1, abs=1e-3)
    np.testing.assert_allclose(solution.calibration("antenna").value, [0.5, -0.3], atol=1e-2)
    expected = se3.exp([0, 0, 0.1, 0.2, -0.1, 0])
    np.testing.assert_allclose(solution.calibration("camera").value, expected, atol=1e-2)


def test_what_the_motion_does_not_determine_stays_and_is_named():
    level = driving(3, turning=True).optimize().calibration("camera")
    # where all turns are about z, nothing moves with the camera's height
    assert "do not determine z; there" in level.doubt
    assert abs(level.change[5]) < 0.03
    assert level.sigmas[5] == pytest.approx(0.3, rel=0.05)
    straight = driving(2, turning=False).optimize().calibration("camera")
    assert "x, y; there it stays as stated" in straight.doubt
    assert straight.undetermined.shape == (2, 3)
    assert straight.covariance[1, 1] == pytest.approx(0.3**2, rel=0.1)


def test_a_variable_without_measurements_stays_as_stated():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    stated_values = {
        "lever_arm": [1, 2, 3],
        "time_offset": 0.1,
        "scale": 1.1,
        "bias": np.arange(6),
        "gravity": [0, 1, 0],
    }
    for kind in CALIBRATION_KINDS:
        graph.add_calibration(kind, kind, stated_values.get(kind), 0.1)
    solution = graph.optimize()
    for kind in CALIBRATION_KINDS:
        found = solution.calibration(kind)
        np.testing.assert_allclose(found.value, stated_values.get(kind, np.eye(4)), atol=1e-9)
        assert found.doubt.endswith("do not determine it; it stays as stated")
        assert str(found).startswith(f"{kind} ({kind})")


@pytest.mark.parametrize("dimension", [2, 3])
def test_files_copies_parts_and_gtsam_keep_the_calibration(dimension, tmp_path):
    graph = driving(dimension, turning=True)
    expected = graph.optimize()
    graph.start_from(expected)
    graph.save(tmp_path / "graph.npz")
    for other in (PoseGraph.load(tmp_path / "graph.npz"), graph.copy(), graph.subgraph(graph.keys)):
        assert other.calibrations == graph.calibrations
        assert other.optimize().error == pytest.approx(expected.error, rel=1e-6)
    joined = PoseGraph(dimension)
    joined.merge(graph, {k: (1, k) for k in graph.keys}, np.eye(4))
    assert joined.calibrations == graph.calibrations
    with pytest.raises(GraphError, match="both graphs have a calibration variable 'antenna'"):
        joined.merge(graph)
    with pytest.raises(GraphError, match=r"cannot hold .*3 × calibration"):
        graph.save(tmp_path / "graph.g2o")
    factors, values = graph.to_gtsam()
    assert gtsam.LevenbergMarquardtOptimizer(factors, values).optimize().exists(gtsam.symbol("c", 0))


def test_wrong_loops_of_a_calibrated_sensor_are_rejected():
    graph = driving(2, turning=True)
    wrong = graph.add_sensor_step(0, 20, se3.exp([0, 0, 1, 3, 0, 0]), "camera", sigmas=0.01)
    right = graph.optimize().pose(3)
    solution = graph.optimize("gnc")
    assert solution.rejected == {wrong}
    assert np.abs(solution.pose(3) - right).max() > 1e-3


def test_online_solvers_refuse_calibration_variables():
    graph = driving(2, turning=True)
    for backend in ("incremental", "fixed-lag"):
        with pytest.raises(GraphError, match="online solvers take no calibration variables; solve the graph by opt"):
            graph.optimize(backend)


def test_wrong_use_is_named():
    graph = driving(3, turning=True)
    with pytest.raises(GraphError, match="gps 1: there is no calibration variable 'roof'; add it by add_calibration"):
        graph.add_gps(1, np.zeros(3), 1.0, calibration="roof")
    with pytest.raises(GraphError, match="takes lever_arm, time_offset as calibration, but 'camera' is of kind extr"):
        graph.add_gps(1, np.zeros(3), 1.0, calibration=["camera"])
    with pytest.raises(GraphError, match="give lever_arm_m or a calibration variable, not both"):
        graph.add_gps(1, np.zeros(3), 1.0, [1, 0, 0], calibration="antenna")
    with pytest.raises(GraphError, match="exists already"):
        graph.add_calibration("antenna", "scale", 1, 1)
    with pytest.raises(GraphError, match=r"unknown kind 'arm'; choose one of lever_arm, .*"):
        graph.add_calibration("x", "arm", 1, 1)
    with pytest.raises(DataError, match="a scale must be positive"):
        graph.add_calibration("x", "scale", 0, 1)
    with pytest.raises(GraphError, match="needs a graph in space"):
        PoseGraph(2).add_calibration("x", "gravity", sigmas=1)
    with pytest.raises(GraphError, match="no calibration variable is given; without one use add_between"):
        graph.add_sensor_step(0, 1, STEP, [], sigmas=1)
    graph.add_calibration("clock", "time_offset", sigmas=0.1)
    graph.add_gps(3, np.zeros(3), 1.0, calibration=["clock"])
    with pytest.raises(GraphError, match="gps 3: its clock needs the velocity of pose 3; add_imu or add_velocity"):
        graph.optimize()


def test_fixes_place_a_planar_graph():
    graph, T = PoseGraph(2), se3.exp([0, 0, 0.4, 3, 1, 0])
    graph.add_pose(0)
    truth = [T]
    for k in range(10):
        graph.add_between(k, k + 1, STEP_2D, sigmas=0.01)
        truth.append(truth[-1] @ STEP_2D)
    for k, at in enumerate(truth):
        graph.add_gps(k, at[:2, 3], 0.05)
        graph.add_gps(k, (at @ [0.5, -0.2, 0, 1])[:2], 0.05, [0.5, -0.2])
    solution = graph.optimize()
    np.testing.assert_allclose(solution.poses, truth, atol=1e-4)
    assert solution.error < 1e-6


STEP_2D = se3.exp([0, 0, 0.2, 1, 0.1, 0])
