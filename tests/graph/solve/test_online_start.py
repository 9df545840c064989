"""Which changes of a graph determine its new poses, judged without solving."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hybridlio.core.sensors import ImuSamples
from hybridlio.graph import PoseGraph
from hybridlio.graph.solve.changes import ChangeTracker
from hybridlio.graph.solve.online_start import determines_new_poses

STILL = ImuSamples(np.arange(5) * 10_000_000, np.zeros((5, 3)), np.tile([0, 0, 9.81], (5, 1)))


def between(graph: PoseGraph, i: int, j: int) -> None:
    graph.add_between(i, j, np.eye(4), sigmas=0.1)


def two_edges_backwards(graph: PoseGraph) -> None:
    graph.add_pose(2)
    between(graph, 2, 1)
    between(graph, 1, 0)


def apart(graph: PoseGraph) -> None:
    graph.add_pose(1)
    between(graph, 1, 2)


def apart_with_prior(graph: PoseGraph) -> None:
    graph.add_prior(1, np.eye(4), sigmas=0.1)
    between(graph, 1, 2)


def apart_and_fixed(graph: PoseGraph) -> None:
    graph.add_pose(1, np.eye(4))
    graph.fix(1)
    between(graph, 1, 2)


def samples(graph: PoseGraph) -> None:
    graph.add_pose(1)
    graph.add_imu(0, 1, STILL)


def samples_and_velocity(graph: PoseGraph) -> None:
    samples(graph)
    graph.add_zero_velocity(0)


def samples_and_velocity_at_their_end(graph: PoseGraph) -> None:
    samples(graph)
    graph.add_zero_velocity(1)


def samples_and_edge(graph: PoseGraph) -> None:
    samples(graph)
    between(graph, 0, 1)


@pytest.mark.parametrize(
    ("add", "determined"),
    [
        (two_edges_backwards, True),
        (apart, False),
        (apart_with_prior, True),
        (apart_and_fixed, True),
        (samples, False),
        (samples_and_velocity, True),
        (samples_and_velocity_at_their_end, True),
        (samples_and_edge, False),  # determined, but only the whole graph shows it
    ],
)
def test_new_factors_determine_new_poses_where_they_lead_there(add: Callable[[PoseGraph], None], determined: bool):
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    tracker = ChangeTracker(graph._data)
    tracker.accept(tracker.read())
    add(graph)
    assert determines_new_poses(graph._data, tracker.read(), set()) == determined


def test_an_estimated_velocity_lets_samples_lead_on():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    tracker = ChangeTracker(graph._data)
    tracker.accept(tracker.read())
    samples(graph)
    assert determines_new_poses(graph._data, tracker.read(), {0})
