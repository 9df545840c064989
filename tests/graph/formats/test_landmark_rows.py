"""Landmarks in text: g2o's rows and GTSAM's, written and read back, and errors that name the row."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import PoseGraph

PLANE = """VERTEX_SE2 0 0 0 0
VERTEX_XY 5 1 2
EDGE_SE2_XY 0 5 1 2 4 0.5 9
"""
SPACE = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_TRACKXYZ 5 1 2 3
EDGE_SE3_TRACKXYZ 0 5 0 1 2 3 4 0.5 0 9 0 16
"""
GTSAMS = """ODOMETRY 0 1 1 0 0.1 0.0001 0 0 4e-06 0 9e-06
LANDMARK 0 1 3 4 0.4 0 0.4
BR 1 7 0.5 2 0.1 0.2
"""


def load(tmp_path: Path, text: str) -> PoseGraph:
    (tmp_path / "a.g2o").write_text(text)
    return PoseGraph.load(tmp_path / "a.g2o")


@pytest.mark.parametrize("text", [PLANE, SPACE, SPACE.replace("TRACKXYZ", "POINT_XYZ")])
def test_points_and_their_observations_are_read(tmp_path, text):
    graph = load(tmp_path, text)
    assert (graph.keys, graph.landmarks) == ([0], [5])
    (factor,) = graph.factors.values()
    assert (factor.kind, factor.keys, factor.landmark, factor.label) == ("point", (0,), 5, "point 0-5")
    d = graph.dimension
    np.testing.assert_array_equal(graph.initial(5), np.arange(1, d + 1))
    np.testing.assert_array_equal(np.diag(factor.noise.information), [4, 9, 16][:d])
    assert factor.noise.information[0, 1] == 0.5
    solution = graph.optimize()
    np.testing.assert_allclose(solution.point(5), np.arange(1, d + 1), atol=1e-6)
    np.testing.assert_allclose(solution.covariance(5), factor.noise.covariance, atol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ending", ["g2o", "npz"])
def test_landmarks_round_trip_to_the_last_bit(rng, tmp_path, dimension, ending):
    graph = PoseGraph(dimension)
    graph.add_prior(0, np.eye(4), sigmas=1)
    graph.add_landmark((11, 3), rng.normal(size=dimension))
    graph.add_point_observation(0, (11, 3), rng.normal(size=dimension), information=2 * np.eye(dimension))
    graph.add_point_observation(0, 7, rng.normal(size=dimension), information=np.eye(dimension), robust=("huber", 2.5))
    if dimension == 2:
        graph.add_bearing_range(0, 7, 0.3, 2.0, sigmas=(0.5, 0.25))
    elif ending == "npz":
        graph.add_bearing_range(0, 7, rng.normal(size=3), 2.0, sigmas=(0.5, 0.25))
    if ending == "g2o":
        graph.set_initial(7, rng.normal(size=dimension))
    graph.save(tmp_path / f"a.{ending}")
    back = PoseGraph.load(tmp_path / f"a.{ending}")
    assert back.landmarks == graph.landmarks == [(11, 3), 7]
    for key in graph.landmarks:
        np.testing.assert_array_equal(back.initial(key), graph.initial(key))
    for mine, other in zip(graph.factors.values(), back.factors.values(), strict=True):
        assert (mine.kind, mine.keys, mine.landmark, mine.robust) == (
            other.kind,
            other.keys,
            other.landmark,
            other.robust,
        )
        np.testing.assert_array_equal(mine.measured, other.measured)
        np.testing.assert_array_equal(mine.noise.information, other.noise.information)


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1)
    graph.add_bearing_range(0, 7, [1, 0, 0], 2.0, sigmas=(0.5, 0.25))
    with pytest.raises(GraphError, match="cannot hold 1 × bearing-range"):
        graph.save(tmp_path / "a.g2o")
    graph.remove(1)
    with pytest.raises(GraphError, match="cannot hold 1 × prior, 1 × landmark"):
        graph.save(tmp_path / "a.graph")
    with pytest.raises(GraphError, match="landmark 7 has no initial value"):
        graph.save(tmp_path / "a.g2o")


def test_observations_of_a_sensor_become_those_of_the_body(tmp_path, rng):
    offset = se3.exp(rng.normal(size=6))
    q = gtsam.Rot3(offset[:3, :3]).toQuaternion()
    numbers = " ".join(map(repr, map(float, [*offset[:3, 3], q.x(), q.y(), q.z(), q.w()])))
    (factor,) = load(tmp_path, f"PARAMS_SE3OFFSET 0 {numbers}\n{SPACE}").factors.values()
    np.testing.assert_allclose(factor.measured, offset[:3, :3] @ [1, 2, 3] + offset[:3, 3])
    expected = offset[:3, :3] @ np.array([[4, 0.5, 0], [0.5, 9, 0], [0, 0, 16]]) @ offset[:3, :3].T
    np.testing.assert_allclose(factor.noise.information, expected)


def test_gtsams_rows_mean_what_gtsam_reads(tmp_path):
    graph = load(tmp_path, GTSAMS)
    assert graph.landmarks == [(11, 1), (11, 7)]  # GTSAM's symbols l1 and l7: their numbers may be those of poses
    bare, values = gtsam.load2D(str(tmp_path / "a.g2o"))
    bare.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    moved = gtsam.Pose2(1.2, 0.1, 0.2)
    values.update(1, moved)
    for number, point in [(1, [2.0, 5.0]), (7, [3.0, 1.0])]:
        values.erase(gtsam.symbol("l", number))
        values.insert(gtsam.symbol("l", number), np.array(point))
    matrix = np.eye(4)
    matrix[np.ix_([0, 1, 3], [0, 1, 3])] = moved.matrix()
    graph.set_initial(1, matrix)
    graph.set_initial((11, 1), [2, 5])
    graph.set_initial((11, 7), [3, 1])
    assert graph.optimize(initial="given", max_iterations=1).error_before == pytest.approx(bare.error(values))


DAMAGED = {
    "an unknown landmark": (PLANE.replace("0 5 1", "0 6 1"), "row 3: no vertex has id 6"),
    "an unknown pose": (PLANE.replace("0 5 1", "1 5 1"), "row 3: no vertex has id 1"),
    "a pose as landmark": (PLANE.replace("0 5 1", "0 0 1"), "row 3: vertex 0 is a pose"),
    "a landmark twice": (PLANE.replace("XY 5", "XY 0"), "row 2: vertex 0 exists already"),
    "a point at the pose": (PLANE.replace("0 5 1 2", "0 5 0 0"), "row 3: .* no bearing"),
    "a negative range": (GTSAMS.replace("0.5 2", "0.5 -2"), "row 3: .* no bearing"),
    "a negative sigma": (GTSAMS.replace("0.1 0.2", "-0.1 0.2"), "row 3: .* positive definite"),
    "an oblong variance": (GTSAMS.replace("0.4 0 0.4", "0.4 0 0.9"), "row 2: .* positive definite"),
    "a missing number": (PLANE.replace(" 9\n", "\n"), "row 3: EDGE_SE2_XY takes 7 values, got 6"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_malformed_rows_are_refused(tmp_path, damage):
    text, message = DAMAGED[damage]
    with pytest.raises(DataError, match=rf"a\.g2o, {message}"):
        load(tmp_path, text)
