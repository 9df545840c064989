"""Errors name the factor or pose at fault and leave the graph unchanged."""

from __future__ import annotations

import re

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError, GraphError
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.graph import PoseGraph

NAN = np.full((4, 4), np.nan)
SKEWED = np.eye(6) + np.triu(np.ones((6, 6)), 1)
NEGATIVE = np.diag([1.0, 1, 1, 1, 1, -1])
STRETCHED = np.diag([2.0, 1, 1, 1])


def small_graph() -> PoseGraph:
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    graph.add_between(0, 1, np.eye(4), sigmas=0.1)
    graph.add_between(1, 2, np.eye(4), sigmas=0.1)
    return graph


def samples(count: int = 5) -> ImuSamples:
    return ImuSamples(np.arange(count) * 10_000_000, np.zeros((count, 3)), np.tile([0, 0, 9.81], (count, 1)))


ONE = np.ones(6)
WRONG = {
    "covariance not symmetric": (lambda g: g.add_between(1, 2, np.eye(4), SKEWED), DataError, "between 1-2.*symmetric"),
    "covariance not positive": (lambda g: g.add_between(1, 2, np.eye(4), NEGATIVE), DataError, "between 1-2.*positive"),
    "information not positive": (lambda g: g.add_prior(1, np.eye(4), information=NEGATIVE), DataError, "prior 1"),
    "covariance of wrong size": (lambda g: g.add_between(1, 2, np.eye(4), np.eye(3)), DataError, "between 1-2"),
    "sigmas not positive": (lambda g: g.add_between(1, 2, np.eye(4), sigmas=0 * ONE), DataError, "between 1-2.*sitive"),
    "two noises": (lambda g: g.add_prior(1, np.eye(4), np.eye(6), sigmas=ONE), GraphError, "prior 1.*exactly one of"),
    "no noise": (lambda g: g.add_between(1, 2, np.eye(4)), GraphError, "between 1-2.*exactly one of"),
    "pose not finite": (lambda g: g.add_between(1, 2, NAN, sigmas=ONE), DataError, "between 1-2.*finite"),
    "pose not rigid": (lambda g: g.add_between(1, 2, STRETCHED, sigmas=ONE), DataError, "between 1-2.*rigid"),
    "initial value not finite": (lambda g: g.add_pose(7, NAN), DataError, "pose 7"),
    "key used twice": (lambda g: g.add_pose(1), GraphError, "pose 1 exists already"),
    "from an unknown key": (lambda g: g.add_between(8, 2, np.eye(4), sigmas=ONE), GraphError, "between 8-2.*key 8"),
    "to itself": (lambda g: g.add_between(2, 2, np.eye(4), sigmas=ONE), GraphError, "itself"),
    "GPS at an unknown key": (lambda g: g.add_gps(9, np.zeros(3), 1), GraphError, "gps 9"),
    "GPS not finite": (lambda g: g.add_gps(1, [0, np.inf, 0], 1), DataError, "gps 1.*finite"),
    "latitude out of range": (lambda g: g.add_gps_geodetic(1, 91, 8, 0, 1), DataError, "gps 1.*latitude.*91"),
    "longitude out of range": (lambda g: g.add_gps_geodetic(1, 49, 361, 0, 1), DataError, "gps 1.*longitude.*361"),
    "place not finite": (lambda g: g.add_gps_geodetic(1, 49, 8, np.nan, 1), DataError, "gps 1.*finite"),
    "place at an unknown key": (lambda g: g.add_gps_geodetic(9, 49, 8, 0, 1), GraphError, "gps 9"),
    "place without noise": (lambda g: g.add_gps_geodetic(1, 49, 8, 0), GraphError, "gps 1.*one of"),
    "origin out of range": (lambda g: g.set_origin(-90.1, 8, 0), DataError, "origin.*latitude"),
    "attitude without length": (lambda g: g.add_attitude(1, np.zeros(3), [0, 0, 1], 0.1), DataError, "not be zero"),
    "IMU to an unknown key": (lambda g: g.add_imu(1, 9, samples()), GraphError, "imu 1-9.*key 9"),
    "one IMU sample": (lambda g: g.add_imu(1, 2, samples(1)), DataError, "imu 1-2.*at least 2.*got 1"),
    "IMU without noise": (lambda g: g.add_imu(1, 2, samples(), ImuNoise(0)), DataError, "imu 1-2.*positive"),
    "unknown kernel": (
        lambda g: g.add_between(1, 2, np.eye(4), sigmas=ONE, robust="magic"), ConfigError, "between 1-2.*magic"
    ),
    "kernel without width": (
        lambda g: g.add_between(1, 2, np.eye(4), sigmas=ONE, robust=("huber", 0)), ConfigError, "width"
    ),
    "unknown factor": (lambda g: g.remove(99), GraphError, "no factor has id 99"),
    "negative key": (lambda g: g.add_pose(-1), GraphError, "-1"),
    "key of text": (lambda g: g.add_pose("x1"), GraphError, "x1"),
    "key of three": (lambda g: g.add_pose((1, 2, 3)), GraphError, re.escape("(1, 2, 3)")),
    "fixed unknown key": (lambda g: g.fix(5), GraphError, "key 5"),
    "unknown backend": (lambda g: g.optimize("newton"), ConfigError, "newton"),
    "unknown initialisation": (lambda g: g.initialise("magic"), ConfigError, "magic"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_an_error_names_the_cause_and_leaves_the_graph_unchanged(case):
    call, kind, message = WRONG[case]
    graph = small_graph()
    before, initial = (graph.keys, dict(graph.factors), graph.fixed), [graph.initial(key) for key in graph.keys]
    with pytest.raises(kind, match=message):
        call(graph)
    assert before == (graph.keys, dict(graph.factors), graph.fixed)
    assert graph.origin is None
    for key, pose in zip(graph.keys, initial, strict=True):
        np.testing.assert_array_equal(graph.initial(key), pose)


def test_imu_samples_out_of_order_are_refused_by_row():
    stamps = np.array([0, 10, 5]) * 1_000_000
    with pytest.raises(DataError, match="row 2"):
        small_graph().add_imu(0, 1, ImuSamples(stamps, np.zeros((3, 3)), np.zeros((3, 3))))


def test_a_graph_without_anchor_is_refused_by_key():
    graph = PoseGraph()
    graph.add_pose(3)
    graph.add_between(3, 4, np.eye(4), sigmas=0.1)
    with pytest.raises(GraphError, match=r"poses 3, 4 are free in rotation about x.* z\. Add a prior"):
        graph.optimize()


def test_a_pose_without_factors_is_named():
    graph = small_graph()
    graph.add_pose(77, np.eye(4))
    with pytest.raises(GraphError, match="no factor concerns pose 77"):
        graph.optimize()


def test_parts_that_no_factor_joins_are_named():
    graph = small_graph()
    graph.add_pose(10)
    graph.add_between(10, 11, np.eye(4), sigmas=0.1)
    assert graph.components() == [[0, 1, 2], [10, 11]]
    with pytest.raises(GraphError, match="2 parts that no factor joins; poses 10, 11 are free"):
        graph.optimize()


def test_directions_that_gps_does_not_determine_are_named():
    graph = PoseGraph()
    graph.add_pose(0)
    for k in range(3):
        graph.add_between(k, k + 1, np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3), sigmas=0.1)
    graph.add_gps(0, [0, 0, 0], 0.1)
    with pytest.raises(GraphError, match="rotation about x, rotation about y, rotation about z"):
        graph.optimize()
    graph.add_gps(3, [3, 0, 0], 0.1)
    with pytest.raises(GraphError, match="are free in rotation about x"):
        graph.optimize()
    graph.add_gps(3, [3, 0.02, 0], 0.1)  # again: the noise of two fixes of one place shows no direction
    with pytest.raises(GraphError, match="are free in rotation about x"):
        graph.optimize()
    graph.add_gravity(0, [0, 0, 9.81], 0.01)
    np.testing.assert_allclose(graph.optimize().pose(2)[:3, 3], [2, 0.02, 0], atol=0.02)


def test_an_undetermined_velocity_is_refused():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    graph.add_pose(1, np.eye(4))
    graph.add_imu(0, 1, samples())
    with pytest.raises(GraphError, match="velocity along the inertial factors of poses 0, 1"):
        graph.optimize()


def test_initial_given_names_poses_without_initial_value():
    with pytest.raises(GraphError, match="pose 1, 2 has no initial value"):
        small_graph().optimize(initial="given")


def test_a_broken_odometry_chain_is_named():
    graph = small_graph()
    graph.add_between(0, 5, np.eye(4), sigmas=0.1)
    with pytest.raises(GraphError, match="leads to pose 5"):
        graph.initialise("odometry")


def test_a_planar_graph_refuses_poses_and_factors_out_of_the_plane():
    graph = PoseGraph(dimension=2)
    graph.add_prior(0, np.eye(3), sigmas=0.1)
    tilted = np.eye(4)
    tilted[2, 3] = 0.1
    with pytest.raises(DataError, match="z, roll or pitch is not zero"):
        graph.add_between(0, 1, tilted, sigmas=0.1)
    with pytest.raises(DataError, match="expected 2 finite numbers"):
        graph.add_gps(0, np.zeros(3), 0.1)
    with pytest.raises(GraphError, match="needs a graph in space"):
        graph.add_altitude(0, 0.0, 0.1)


def test_an_empty_graph_is_refused():
    with pytest.raises(GraphError, match="no poses"):
        PoseGraph().optimize()


def test_a_solution_refuses_unknown_keys_and_quantities():
    solution = small_graph().optimize()
    for call, message in [
        (lambda: solution.pose(9), "key 9"),
        (lambda: solution.covariance(9), "key 9"),
        (lambda: solution.velocity(1), "pose 1 has no velocity"),
        (lambda: solution.bias(1), "pose 1 has no biases"),
        (lambda: solution.chi2(55), "no factor has id 55"),
    ]:
        with pytest.raises(GraphError, match=message):
            call()


def test_a_heading_that_only_noise_determines_is_one_error_of_an_online_solver_too():
    graph = PoseGraph(2)
    graph.add_pose(0)
    graph.add_factor(0, lambda P: P[:2, 3] - [18.0, 8.0], [0.1, 0.1])
    for _ in range(2):
        graph.add_gps(0, [17.99, 8.01], 0.1)
    with pytest.raises(GraphError, match=r"cannot be solved|are free in"):
        graph.optimize("incremental")
