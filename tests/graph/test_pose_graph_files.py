"""Pose graph files: exact round trips, agreement with GTSAM's reader, and errors that name the row."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.graph import PoseGraph

SPACE = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1.5 0.25 -0.125 0 0 0.6 0.8
EDGE_SE3:QUAT 0 1 1.5 0.25 -0.125 0 0 0.6 0.8 1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6
"""
PLANE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.5 0.25 0.5
EDGE_SE2 0 1 1.5 0.25 0.5 1 0.1 0.2 2 0.3 3
"""


def random_information(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T * 1e-3 + 1e-6 * np.eye(size)


def full_graph(rng: np.random.Generator, dimension: int = 3) -> PoseGraph:
    """Return a graph with robots, a removed factor, kernels, a fixed pose and every form of noise, kilometres away."""
    graph, size = PoseGraph(dimension), 6 if dimension == 3 else 3
    used = slice(0, 6) if dimension == 3 else slice(2, 5)

    def pose(scale: float) -> np.ndarray:
        xi = np.zeros(6)
        xi[used] = scale * rng.normal(size=size)
        return se3.exp(xi)

    keys = [3, 1, (0, 4), (7, 123456), 2]
    for key in keys:
        graph.add_pose(key, pose(1.0) @ se3.make(np.eye(3), [4321.987, -1234.567, 0]))
    graph.fix((0, 4))
    for i, j in [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)]:
        graph.add_between(keys[i], keys[j], pose(1.0), information=random_information(rng, size))
    graph.remove(2)
    graph.add_between(1, 2, pose(0.3), random_information(rng, size), robust=("cauchy", 1.2345678901234567))
    graph.add_prior(3, pose(1.0), sigmas=rng.uniform(0.1, 1, size), robust="dcs")
    return graph


def add_inertial(graph: PoseGraph, rng: np.random.Generator) -> None:
    for count, i, j in [(7, 1, 2), (4, 2, 3)]:
        stamps = 1_700_000_000_123_456_789 + np.arange(count) * 10_000_001
        graph.add_imu(
            i, j, ImuSamples(stamps, rng.normal(size=(count, 3)), rng.normal(size=(count, 3))), ImuNoise(2e-3)
        )
    graph.add_gps(2, rng.normal(size=3), [1, 2, 3], rng.normal(size=3), robust="huber")
    graph.add_gravity(1, rng.normal(size=3), 0.01)
    graph.add_zero_velocity(1)
    graph.add_bias(2, rng.normal(size=3), rng.normal(size=3), rng.uniform(0.1, 1, 6))


def assert_same(a: PoseGraph, b: PoseGraph, ids: bool = True, forms: bool = True) -> None:
    """Check that two graphs are equal to the last bit."""
    assert (a.dimension, a.keys, a.fixed) == (b.dimension, b.keys, b.fixed)
    for key in a.keys:
        np.testing.assert_array_equal(a.initial(key), b.initial(key))
    assert not ids or list(a.factors) == list(b.factors)
    assert len(a.factors) == len(b.factors)
    for mine, other in zip(a.factors.values(), b.factors.values(), strict=True):
        assert (mine.kind, mine.keys, mine.robust) == (other.kind, other.keys, other.robust)
        np.testing.assert_array_equal(mine.measured, other.measured)
        if mine.noise is not None and forms:
            assert mine.noise.form == other.noise.form
            np.testing.assert_array_equal(mine.noise.values, other.noise.values)
        elif mine.noise is not None:
            np.testing.assert_array_equal(mine.noise.information, other.noise.information)
        for name in ("stamps_ns", "gyro_rad_s", "accel_m_s2") if mine.samples else ():
            np.testing.assert_array_equal(getattr(mine.samples, name), getattr(other.samples, name))


@pytest.mark.parametrize("dimension", [2, 3])
def test_npz_round_trips_to_the_last_bit(rng, tmp_path, dimension):
    graph = full_graph(rng, dimension)
    if dimension == 3:
        add_inertial(graph, rng)
    graph.add_pose(99)
    graph.save(tmp_path / "graph.npz")
    back = PoseGraph.load(tmp_path / "graph.npz")
    assert_same(graph, back)
    assert back.add_prior(1, np.eye(4), sigmas=1) == graph.add_prior(1, np.eye(4), sigmas=1)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ending", ["g2o", "graph"])
def test_text_round_trips_poses_and_information_to_the_last_bit(rng, tmp_path, dimension, ending):
    graph = full_graph(rng, dimension)
    if ending == "graph":
        graph.remove(max(graph.factors))  # TORO has no priors
    path, again = tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    graph.save(path)
    back = PoseGraph.load(path)
    if ending == "graph" and dimension == 3:  # as Euler angles, the last bit may differ
        np.testing.assert_allclose(
            [back.initial(key) for key in back.keys], [graph.initial(key) for key in graph.keys], atol=1e-12
        )
        return
    assert_same(graph, back, ids=False, forms=False)
    back.save(again)
    assert path.read_text() == again.read_text()


@pytest.mark.parametrize("text", [SPACE, PLANE], ids=["space", "plane"])
def test_gtsam_reads_our_files_as_we_do(text, tmp_path):
    path, written = tmp_path / "a.g2o", tmp_path / "b.g2o"
    path.write_text(text)
    graph = PoseGraph.load(path)
    graph.save(written)
    for file in (path, written):
        factors, values = gtsam.readG2o(str(file), graph.dimension == 3)
        factor = factors.at(0)
        values.erase(1)
        if graph.dimension == 3:
            moved = gtsam.Pose3(se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
            values.insert(1, moved)
            matrix = moved.matrix()
        else:
            moved = gtsam.Pose2(0.4, 0.5, 0.3)
            values.insert(1, moved)
            matrix = np.eye(4)
            matrix[np.ix_([0, 1, 3], [0, 1, 3])] = moved.matrix()
        graph.set_initial(1, matrix)
        solution = graph.optimize(initial="given", max_iterations=1)
        assert solution.error_before == pytest.approx(factor.error(values), rel=1e-9)


def test_information_in_text_is_translation_first(tmp_path):
    (tmp_path / "a.g2o").write_text(SPACE)
    (factor,) = PoseGraph.load(tmp_path / "a.g2o").factors.values()
    np.testing.assert_array_equal(factor.noise.information, np.diag([4.0, 5, 6, 1, 2, 3]))
    (tmp_path / "b.g2o").write_text(PLANE)
    (factor,) = PoseGraph.load(tmp_path / "b.g2o").factors.values()
    np.testing.assert_array_equal(factor.noise.information, [[3, 0.2, 0.3], [0.2, 1, 0.1], [0.3, 0.1, 2]])


def test_planar_toro_information_is_read_in_toros_order_or_row_by_row(tmp_path):
    (tmp_path / "a.graph").write_text("VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 10 1 20 30 2 3\n")
    (factor,) = PoseGraph.load(tmp_path / "a.graph").factors.values()
    np.testing.assert_array_equal(factor.noise.information, [[30, 2, 3], [2, 10, 1], [3, 1, 20]])
    # the same tag with the triangle row by row: in TORO's order this matrix is indefinite
    (tmp_path / "b.graph").write_text("VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 10 0 0 20 0 30\n")
    (factor,) = PoseGraph.load(tmp_path / "b.graph").factors.values()
    np.testing.assert_array_equal(factor.noise.information, np.diag([30.0, 10, 20]))


def test_toro_angles_are_roll_pitch_yaw(tmp_path):
    (tmp_path / "a.graph").write_text("VERTEX3 0 1 2 3 0.1 0.2 0.3\n")
    expected = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, 0.1), [1, 2, 3]).matrix()
    np.testing.assert_allclose(PoseGraph.load(tmp_path / "a.graph").initial(0), expected, atol=1e-15)


def test_save_writes_a_solutions_poses_as_initial_values(rng, tmp_path):
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    graph.add_between(0, 1, se3.exp(rng.normal(size=6)), sigmas=0.1, robust="huber")
    solution = graph.optimize()
    for name in ("map.g2o", "map.npz"):
        graph.save(tmp_path / name, solution)
        np.testing.assert_array_equal(PoseGraph.load(tmp_path / name).initial(1), solution.pose(1))
    assert graph.initial(1) is None


def test_a_file_of_edges_alone_can_be_solved(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text("".join(f"EDGE_SE2 {k} {k + 1} 1 0 0.1 1 0 0 1 0 1\n" for k in range(4)))
    graph = PoseGraph.load(path)
    assert graph.fixed == {0}
    graph.save(tmp_path / "b.g2o")
    assert (tmp_path / "b.g2o").read_text().count("VERTEX") == 0
    assert_same(graph, PoseGraph.load(tmp_path / "b.g2o"))
    step = se3.exp([0, 0, 0.1, 1, 0, 0])
    step[:2, 3] = 1, 0
    np.testing.assert_allclose(graph.optimize().pose(4), np.linalg.matrix_power(step, 4), atol=1e-6)


E0 = "EDGE_SE2 0 1 1.5 0.25 0.5 1 0 0 2 0 "
DAMAGED = {
    "truncated": (PLANE[:-8], "row 3.*11 values"),
    "a word": (PLANE.replace("0.25 0.5\n", "0.25 abc\n"), "row 2: 'abc' is not a number"),
    "not finite": (PLANE.replace("0.25 0.5\n", "0.25 nan\n"), "row 2.*finite"),
    "a garbled tag": (PLANE.replace("EDGE_SE2", "EDGE_SEX"), "row 3: unknown tag 'EDGE_SEX'"),
    "a garbled number": (PLANE.replace("SE2 1 ", "SE2 1x "), "row 2.*1x"),
    "an edge to nowhere": (PLANE.replace("EDGE_SE2 0 1", "EDGE_SE2 0 9"), "row 3: no vertex has id 9"),
    "an edge to itself": (PLANE.replace("EDGE_SE2 0 1", "EDGE_SE2 1 1"), "row 3.*itself"),
    "a vertex twice": (PLANE.replace("SE2 1 ", "SE2 0 ", 1), "row 2: pose 0 exists already"),
    "information not positive": (PLANE.replace("2 0.3 3", "2 0.3 -3"), "row 3.*positive definite"),
    "plane and space": (PLANE + SPACE, "in the plane and in space"),
    "nothing": ("", "no poses"),
    "a long quaternion": (SPACE.replace("0.6 0.8\n", "0.6 0.9\n", 1), "row 2.*unit length"),
    "a number too large": (PLANE.replace("SE2 1 ", f"SE2 {2**63} "), "row 2"),
    "a kernel without width": ("# robust huber\n" + PLANE, "row 1.*kernel"),
    "fixed nowhere": (PLANE + "FIX 12\n", "key 12"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_malformed_text_is_refused_by_row(tmp_path, damage):
    text, message = DAMAGED[damage]
    (tmp_path / "bad.g2o").write_text(text)
    with pytest.raises(DataError, match=f"bad.g2o.*{message}"):
        PoseGraph.load(tmp_path / "bad.g2o")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.7, 0.99])
def test_a_truncated_archive_is_refused(rng, tmp_path, keep):
    full_graph(rng).save(tmp_path / "a.npz")
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(data[: int(keep * len(data))])
    with pytest.raises(DataError, match=r"a\.npz"):
        PoseGraph.load(tmp_path / "a.npz")


def test_a_file_without_one_of_its_arrays_is_read_or_refused_clearly(rng, tmp_path):
    """A between-factor without its noise stopped at an assertion."""
    graph = full_graph(rng)
    add_inertial(graph, rng)
    graph.add_range(3, (1, 77), 12.0, sigma_m=0.1)
    graph.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as stored:
        arrays = dict(stored)
    refused = set()
    for left_out in arrays:
        np.savez(tmp_path / "b.npz", **{name: array for name, array in arrays.items() if name != left_out})
        try:
            PoseGraph.load(tmp_path / "b.npz")
        except DataError:
            refused.add(left_out)
    assert {"keys", "initial", "between_noise", "imu_sample_count", "imu_stamps_ns", "range_landmark"} <= refused


def test_missing_files_and_formats_that_cannot_hold_the_graph_are_refused(rng, tmp_path):
    with pytest.raises(DataError, match=r"missing\.g2o"):
        PoseGraph.load(tmp_path / "missing.g2o")
    with pytest.raises(DataError, match=r"missing\.npz"):
        PoseGraph.load(tmp_path / "missing.npz")
    graph = full_graph(rng)
    with pytest.raises(DataError, match=r"ending \.csv"):
        graph.save(tmp_path / "a.csv")
    add_inertial(graph, rng)
    with pytest.raises(GraphError, match=r"cannot hold 2 × imu, 1 × gps.*npz"):
        graph.save(tmp_path / "a.g2o")
    graph = full_graph(rng)
    graph.add_pose(50)
    with pytest.raises(GraphError, match="pose 50 has no initial value"):
        graph.save(tmp_path / "a.g2o")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "MIT", "intel", "kitti_00"])
def test_public_benchmarks_solve_and_round_trip(shared_data: Path, tmp_path, name):
    path = shared_data / "pose_graphs" / f"{name}.g2o"
    graph = PoseGraph.load(path)
    bare, values = gtsam.readG2o(str(path), graph.dimension == 3)
    assert (len(graph), len(graph.factors)) == (values.size(), bare.size())
    read = values.atPose3 if graph.dimension == 3 else values.atPose2
    first = read(0)
    make = gtsam.PriorFactorPose3 if graph.dimension == 3 else gtsam.PriorFactorPose2
    bare.add(make(0, first, gtsam.noiseModel.Isotropic.Sigma(6 if graph.dimension == 3 else 3, 1e-6)))
    gtsams = bare.error(gtsam.LevenbergMarquardtOptimizer(bare, values).optimize())
    assert graph.optimize(tolerance=1e-8).error <= gtsams * (1 + 1e-6)
    graph.save(tmp_path / "again.g2o")
    assert_same(graph, PoseGraph.load(tmp_path / "again.g2o"))
