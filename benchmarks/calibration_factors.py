"""Processor time of one evaluation and one linearisation of each factor that depends on calibration variables.

    python benchmarks/calibration_factors.py

Prints microseconds a call, for the built-in between-factor, and for factors of GTSAM's own and in Python.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hybridlio.core import se3
from hybridlio.core.sensors import ImuSamples
from hybridlio.graph import PoseGraph
from hybridlio.graph.solve.builder import Builder

_CALLS = 2000


def example() -> tuple[PoseGraph, dict[str, int]]:
    """Return a graph of two poses, and the id of each factor to be timed."""
    graph, rng = PoseGraph(), np.random.default_rng(0)
    graph.add_prior(0, np.eye(4), sigmas=1.0)
    step = se3.exp([0.1, 0.2, 0.3, 1, 0, 0])
    for name, kind in (("arm", "lever_arm"), ("mount", "extrinsics"), ("clock", "time_offset"), ("scale", "scale")):
        graph.add_calibration(name, kind, sigmas=0.1)  # type: ignore[arg-type]
    ids = {"between-factor": graph.add_between(0, 1, step, sigmas=0.1)}
    graph.add_imu(0, 1, ImuSamples(np.arange(11) * 10_000_000, rng.normal(size=(11, 3)), rng.normal(size=(11, 3))))
    ids["fix, antenna"] = graph.add_gps(1, np.zeros(3), 1.0, calibration="arm")
    ids["fix, antenna and clock"] = graph.add_gps(1, np.zeros(3), 1.0, calibration=["arm", "clock"])
    ids["step, extrinsics"] = graph.add_sensor_step(0, 1, step, "mount", sigmas=0.1)
    ids["step, extrinsics, clock, scale"] = graph.add_sensor_step(0, 1, step, ["mount", "clock", "scale"], sigmas=0.1)
    return graph, ids


def microseconds(call: Callable[[], object]) -> float:
    """Return the processor time of a call."""
    start = time.process_time()
    for _ in range(_CALLS):
        call()
    return (time.process_time() - start) / _CALLS * 1e6


def main() -> None:
    """Print the times."""
    graph, ids = example()
    builder = Builder(graph._data)
    order, made = builder.factor_ids(), builder.graph()
    values = builder.values(graph.optimize().coordinates)
    for name, number in ids.items():
        factor = made.at(order.index(number))
        evaluated = microseconds(lambda factor=factor: factor.error(values))  # type: ignore[misc]
        linearised = microseconds(lambda factor=factor: factor.linearize(values))  # type: ignore[misc]
        print(f"{name:32} {evaluated:6.0f} µs evaluated, {linearised:6.0f} µs linearised")


if __name__ == "__main__":
    main()
