"""``hybridlio optimize`` solves a pose graph file, and says where the result is doubtful."""

from __future__ import annotations

import numpy as np
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.core import se3
from hybridlio.graph import PoseGraph


def graph_file(folder):
    graph, step = PoseGraph(), se3.exp([0, 0, np.pi / 2, np.pi / 2, 0, 0])
    graph.add_prior(0, np.eye(4), sigmas=1e-2)
    for k in range(3):
        graph.add_between(k, k + 1, step @ se3.exp([0, 0, 0.01, 0.1, 0, 0]), sigmas=0.1)
    graph.add_between(3, 0, step, sigmas=0.1)
    graph.save(folder / "in.g2o", graph.optimize())
    return graph


def run(*arguments):
    return CliRunner().invoke(app, ["optimize", *map(str, arguments)])


def test_the_solved_graph_and_its_picture_are_written_once(tmp_path):
    graph = graph_file(tmp_path)
    arguments = tmp_path / "in.g2o", "-o", tmp_path / "out.g2o", "--solver", "gnc", "--plot", tmp_path / "out.png"
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    assert "4 poses" in done.output
    np.testing.assert_allclose(PoseGraph.load(tmp_path / "out.g2o").initial(2), graph.optimize().pose(2), atol=1e-6)
    assert (tmp_path / "out.png").stat().st_size > 1000
    assert run(*arguments).exit_code == 2
    assert run(*arguments, "--overwrite").exit_code == 0


def test_an_unknown_solver_is_named(tmp_path):
    graph_file(tmp_path)
    done = run(tmp_path / "in.g2o", "--solver", "magic")
    assert done.exit_code == 2
    assert "magic" in done.output
