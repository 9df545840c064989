"""Pose graphs as other programs write them: what is read, repaired, left out or refused, and with which counts."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.graph import PoseGraph

CHAIN = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 400 0 0 400 0 400
"""
PLANAR = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.5 0.25 0.5
EDGE_SE2 0 1 1.5 0.25 0.5 1 0.1 0.2 2 0.3 3
EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1
FIX 0
"""
SPATIAL = f"""PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
{CHAIN}EDGE_SE3_PRIORXYZ 1 1 0 0 1 0 0 1 0 1
EDGE_SE3_PRIOR 0 0 0 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
FIX 0
"""
MARKED = f"""{CHAIN}VERTEX_TRACKXYZ 5 1 2 3
EDGE_SE3_TRACKXYZ 0 5 0 1 2 3 1 0 0 1 0 1
"""
GTSAMS = """ODOMETRY 0 1 1 0 0.1 0.0001 0 0 4e-06 0 9e-06
LANDMARK 0 1 3 4 0.4 0 0.4
BR 1 7 0.5 2 0.1 0.2
"""


def load(tmp_path: Path, text: str | bytes, **options) -> PoseGraph:
    path = tmp_path / "a.g2o"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return PoseGraph.load(path, **options)


def test_a_byte_order_mark_is_read(tmp_path):
    graph = load(tmp_path, "\ufeff" + CHAIN)
    assert graph.keys == [0, 1]
    assert not graph.load_report
    assert str(graph.load_report) == "read everything as it is"


def test_a_position_prior_is_a_fix_without_lever_arm(tmp_path):
    graph = load(tmp_path, CHAIN + "EDGE_SE3_PRIORXYZ 1 1 2 3 4 0 0 5 0 6\n")
    _, factor = graph.factors.values()
    assert (factor.kind, factor.keys) == ("gps", (1,))
    np.testing.assert_array_equal(factor.measured, [1, 2, 3, 0, 0, 0])
    np.testing.assert_array_equal(factor.noise.information, np.diag([4.0, 5, 6]))
    assert graph.fixed == {0}  # one position does not place the graph
    graph.save(tmp_path / "b.g2o")
    again = PoseGraph.load(tmp_path / "b.g2o")
    np.testing.assert_array_equal(again.factors[1].measured, factor.measured)
    assert again.fixed == graph.fixed


def test_three_position_priors_place_a_graph(tmp_path):
    rows = [f"EDGE_SE3_PRIORXYZ {k} {k == 1:d} {k == 2:d} 0 1 0 0 1 0 1\n" for k in range(3)]
    more = CHAIN.splitlines()[0].replace(" 0 0 0 0 0", " 2 0 1 0 0", 1) + "\n"
    edge = CHAIN.splitlines()[2].replace("0 1 1 0 0", "0 2 0 1 0", 1) + "\n"
    assert load(tmp_path, CHAIN + more + edge + "".join(rows)).fixed == frozenset()


def test_priors_of_a_sensor_become_priors_of_the_body(tmp_path, rng):
    offset, T = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
    plain = load(tmp_path, SPATIAL.replace("FIX 0\n", ""))
    plain.save(tmp_path / "b.g2o")
    numbers = " ".join(map(repr, [*offset[:3, 3].tolist(), *_quaternion(offset)]))
    text = SPATIAL.replace("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", f"PARAMS_SE3OFFSET 0 {numbers}")
    (prior,) = (f for f in load(tmp_path, text).factors.values() if f.kind == "prior")
    graph = PoseGraph()
    graph.add_pose(0, T)
    number = graph.add_prior(0, _pose(prior.measured), information=prior.noise.information)
    graph.add_pose(1, T @ offset)
    sensor = graph.add_prior(1, np.eye(4), sigmas=1)
    solution = graph.optimize(initial="given", max_iterations=1)
    np.testing.assert_allclose(_pose(prior.measured) @ offset, np.eye(4), atol=1e-12)
    assert solution.chi2(number) == pytest.approx(0, abs=1e-9)
    step = 1e-4 * rng.normal(size=6)
    adjoint = se3.adjoint(se3.inverse(offset)) @ step
    assert step @ prior.noise.information @ step == pytest.approx(adjoint @ adjoint)
    assert sensor in graph.factors


def _pose(coordinates: np.ndarray) -> np.ndarray:
    from hybridlio.graph.model.coordinates import to_matrices

    return to_matrices(coordinates[None])[0]


def _quaternion(T: np.ndarray) -> list[float]:
    from hybridlio.graph.model.coordinates import from_matrices

    return from_matrices(T[None], 3)[0, 3:].tolist()


def test_planes_are_left_out_with_counts_and_refused_when_strict(tmp_path, caplog):
    text = CHAIN + "VERTEX_PLANE 7 0 0 1 0\nEDGE_SE3_PLANE 0 7 0 0 1 0 1 0 0 1 0 1\n"
    with caplog.at_level(logging.WARNING):
        graph = load(tmp_path, text)
    assert graph.load_report.left_out == {"VERTEX_PLANE": 1, "EDGE_SE3_PLANE": 1}
    assert "left out 1 × VERTEX_PLANE, 1 × EDGE_SE3_PLANE" in caplog.text
    with pytest.raises(DataError, match=r"a.g2o, row 4: unsupported tag 'VERTEX_PLANE'"):
        load(tmp_path, text, strict=True)


def test_unknown_rows_are_refused_unless_dropped(tmp_path):
    text = CHAIN + "VERTEX_SWITCH 9 1\n"
    with pytest.raises(DataError, match=r"row 4: unknown tag 'VERTEX_SWITCH'; drop=\('VERTEX_SWITCH',\)"):
        load(tmp_path, text)
    assert load(tmp_path, text, drop=("VERTEX_SWITCH",)).load_report.left_out == {"VERTEX_SWITCH": 1}


def test_indefinite_information_is_refused_or_repaired_to_the_nearest(tmp_path):
    text = CHAIN.replace(" 1 100 0 0", " 1 -50 0 0")
    with pytest.raises(DataError, match=r"row 3: .* not positive definite; load with repair=True"):
        load(tmp_path, text)
    graph = load(tmp_path, text, repair=True)
    assert graph.load_report.repaired == 1
    information = graph.factors[0].noise.information
    np.testing.assert_allclose(information, np.diag([400.0, 400, 400, 400e-9, 100, 100]), atol=1e-9)
    assert load(tmp_path, CHAIN, repair=True).load_report.repaired == 0


def test_toro_edges_without_information_get_the_identity(tmp_path, caplog):
    text = "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 0 0 0 0 0\n" + 2 * "EDGE3 0 1 1 0 0 0 0 0\n"
    with caplog.at_level(logging.WARNING):
        graph = load(tmp_path, text)
    np.testing.assert_array_equal(graph.factors[0].noise.information, np.eye(6))
    assert graph.load_report.without_information == 2
    assert len(caplog.records) == 1
    with pytest.raises(DataError, match="row 3: EDGE3 has no information matrix"):
        load(tmp_path, text, strict=True)


def test_bytes_that_are_no_text_are_refused_by_row(tmp_path):
    with pytest.raises(DataError, match=r"a.g2o, row 2: .*UTF-8"):
        load(tmp_path, b"# comment\nVERTEX_SE2 \xff 0 0 0\n")


@pytest.mark.parametrize("word", ["١", "1_0", "0x10", "1e400", "nan", "½", "1e", "--1", "9" * 5000, "1,5"])
@pytest.mark.parametrize("place", [1, 3])
def test_odd_digits_are_refused_by_row(tmp_path, word, place):
    words = PLANAR.splitlines()[1].split()
    words[place] = word
    rows = PLANAR.splitlines()
    rows[1] = " ".join(words)
    with pytest.raises(DataError, match=r"a\.g2o, row 2: "):
        load(tmp_path, "\n".join(rows))


@pytest.mark.parametrize("row", ["VERTEX_SE3:QUAT 1 1 0 0 0 0 0 0", "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 0"])
def test_zero_quaternions_are_refused_by_row(tmp_path, row):
    with pytest.raises(DataError, match=r"row 4: the quaternion is not of unit length"):
        load(tmp_path, CHAIN.replace("SE3:QUAT 1", "SE3:QUAT 2").replace("0 1 1", "0 2 1") + row)


ODD = [
    "١",
    "",
    "nan",
    "-1",
    "1e999",
    "0x1",
    "_",
    "9" * 30,
    "0",
    "\x00",
    "\u2028",
    "1 1",
    "#",
    "é",
    "-0",
    "1e-320",
    "\r",
]


@pytest.mark.parametrize("seed", range(200))
def test_mutated_files_are_read_or_refused_by_row(tmp_path, seed):
    rng = np.random.default_rng(seed)
    words = (PLANAR, SPATIAL, MARKED, GTSAMS)[seed % 4].split(" ")
    for _ in range(int(rng.integers(1, 4))):
        words[rng.integers(len(words))] = ODD[rng.integers(len(ODD))]
    message = "a.g2o"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            load(tmp_path, " ".join(words), repair=bool(rng.integers(2)), strict=bool(rng.integers(2)))
        except DataError as error:
            message = str(error)
    assert "a.g2o" in message


CASES = {
    "bom.g2o": ({}, 4, 4, {}),
    "hdl_prior.g2o": ({}, 4, 5, {"left_out": {"EDGE_SE3_PRIORVEC": 1}}),
    "offset_other.g2o": ({}, 4, 4, {}),
    "landmarks_pointxyz.g2o": ({}, 4, 5, {}),
    "plane_glim_hdl.g2o": ({}, 4, 4, {"left_out": {"VERTEX_PLANE": 1, "EDGE_SE3_PLANE": 1}}),
    "indefinite_information.g2o": ({"repair": True}, 2, 1, {"repaired": 1}),
    "toro_without_information.graph": ({}, 2, 1, {"without_information": 1}),
}


@pytest.mark.parametrize("name", CASES)
def test_files_that_other_programs_wrote_are_read_and_solved(shared_data, name):
    options, poses, factors, changed = CASES[name]
    path = shared_data.parent / "cases" / name
    if not path.is_file():
        pytest.skip(f"no file {path}")
    graph = PoseGraph.load(path, **options)
    assert (len(graph), len(graph.factors)) == (poses, factors)
    for field, value in changed.items():
        assert getattr(graph.load_report, field) == value
    assert bool(graph.load_report) == bool(changed)
    graph.optimize()
