"""Graphs of any length are handled on a stack that is large enough, and on the caller's where that is enough."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from hybridlio.core.errors import GraphError
from hybridlio.graph.base.deep_stack import on_deep_stack

_LONG_CHAIN = """
import gtsam
import numpy as np
from hybridlio.graph.base.deep_stack import on_deep_stack

COUNT = 150_000
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise))
step = gtsam.Pose2(1, 0, 0)
for k in range(COUNT):
    values.insert(k, gtsam.Pose2(k, 0, 0))
    if k:
        graph.add(gtsam.BetweenFactorPose2(k - 1, k, step, noise))


def solve():
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    gtsam.GaussNewtonOptimizer(graph, values, params).iterate()


{call}
print("solved")
"""


def run(call: str) -> subprocess.CompletedProcess[str]:
    script = _LONG_CHAIN.replace("{call}", call)
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)


def test_a_chain_of_150_000_poses_is_solved():
    done = run("on_deep_stack(COUNT, solve)")
    assert done.stdout == "solved\n", done.stderr


def test_small_graphs_stay_on_the_callers_thread():
    assert on_deep_stack(1000, threading.current_thread) is threading.current_thread()


def test_nested_calls_share_one_thread():
    outer, inner = on_deep_stack(
        20_000, lambda: (threading.current_thread(), on_deep_stack(15_000, threading.current_thread))
    )
    assert outer is inner is not threading.current_thread()


def test_errors_reach_the_caller_and_the_stack_size_is_as_before():
    before = threading.stack_size()
    with pytest.raises(ZeroDivisionError):
        on_deep_stack(20_000, lambda: 1 / 0)
    assert threading.stack_size() == before


def test_a_stack_that_the_system_does_not_give_is_an_error():
    with pytest.raises(GraphError, match=r"stack of .* MiB"):
        on_deep_stack(2**35, lambda: None)
