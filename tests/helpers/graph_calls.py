"""Every call of PoseGraph's with one argument that may be anything, and what a graph holds, to compare."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from hybridlio.core.sensors import ImuSamples
from hybridlio.graph import PoseGraph

I4, UP = np.eye(4), [0.0, 0.0, 1.0]
SAMPLES = ImuSamples(np.arange(5) * 10_000_000, np.zeros((5, 3)), np.tile([0, 0, 9.81], (5, 1)))
ODD: list[Any] = [
    "x", None, object(), 10**400, [[1], [2, 3]], {}, math.inf, 1j, b"q", [], -1, 1e300, (1, 2, 3), True, np.array("x"),
    {"a": 1}, 5, "huber", ("huber",), ("huber", "x"), math.nan, I4 * 1e200, np.zeros((4, 4)), lambda *_: 1,
]  # fmt: skip


def small_graph() -> PoseGraph:
    """Return a graph of three poses and a landmark."""
    graph = PoseGraph()
    graph.add_prior(0, I4, sigmas=0.1)
    graph.add_between(0, 1, I4, sigmas=0.1)
    graph.add_between(1, 2, I4, sigmas=0.1)
    graph.add_point_observation(1, 50, [1, 2, 3], sigmas=0.1)
    return graph


def followed(graph: PoseGraph) -> Any:
    solver = graph.online()
    solver.update()
    return solver


def _other() -> PoseGraph:
    other = PoseGraph()
    other.add_prior(0, I4, sigmas=1)
    return other


def _gtsam_prior() -> Any:
    return gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1.0))


CALLS: dict[str, Callable[[PoseGraph, Any], object]] = {
    "add_pose key": lambda g, x: g.add_pose(x),
    "add_pose initial": lambda g, x: g.add_pose(9, x),
    "set_initial key": lambda g, x: g.set_initial(x, I4),
    "set_initial value": lambda g, x: g.set_initial(1, x),
    "set_initial landmark": lambda g, x: g.set_initial(50, x),
    "initial": lambda g, x: g.initial(x),
    "start_from": lambda g, x: g.start_from(x),
    "fix": lambda g, x: g.fix(x),
    "unfix": lambda g, x: g.unfix(x),
    "remove": lambda g, x: g.remove(x),
    "remove_pose": lambda g, x: g.remove_pose(x),
    "add_prior key": lambda g, x: g.add_prior(x, I4, sigmas=1),
    "add_prior pose": lambda g, x: g.add_prior(1, x, sigmas=1),
    "add_prior new pose": lambda g, x: g.add_prior(8, x, sigmas=1),
    "add_prior covariance": lambda g, x: g.add_prior(8, I4, x),
    "add_prior information": lambda g, x: g.add_prior(8, I4, information=x),
    "add_prior sigmas": lambda g, x: g.add_prior(8, I4, sigmas=x),
    "add_prior robust": lambda g, x: g.add_prior(8, I4, sigmas=1, robust=x),
    "add_between i": lambda g, x: g.add_between(x, 1, I4, sigmas=1),
    "add_between j": lambda g, x: g.add_between(1, x, I4, sigmas=1),
    "add_between pose": lambda g, x: g.add_between(1, 8, x, sigmas=1),
    "add_between sigmas": lambda g, x: g.add_between(1, 8, I4, sigmas=x),
    "initialise": lambda g, x: g.initialise(x),
    "optimize backend": lambda g, x: g.optimize(x),
    "optimize initial": lambda g, x: g.optimize(initial=x),
    "optimize max_iterations": lambda g, x: g.optimize(max_iterations=x),
    "optimize tolerance": lambda g, x: g.optimize(tolerance=x),
    "optimize lag": lambda g, x: g.optimize("fixed-lag", lag=x),
    "optimize progress": lambda g, x: g.optimize(progress=x),
    "online backend": lambda g, x: g.online(x),
    "online lag": lambda g, x: g.online("fixed-lag", lag=x).update(),
    "load": lambda g, x: g.load(x),
    "save": lambda g, x: g.save(x),
    "add_gps position": lambda g, x: g.add_gps(1, x, 1),
    "add_gps sigmas": lambda g, x: g.add_gps(1, UP, x),
    "add_gps lever arm": lambda g, x: g.add_gps(1, UP, 1, x),
    "add_gps_geodetic latitude": lambda g, x: g.add_gps_geodetic(1, x, 8, 0, 1),
    "add_gps_geodetic altitude": lambda g, x: g.add_gps_geodetic(1, 48, 8, x, 1),
    "set_origin": lambda g, x: g.set_origin(x, 8, 0),
    "add_attitude direction": lambda g, x: g.add_attitude(1, x, UP, 0.1),
    "add_attitude sigma": lambda g, x: g.add_attitude(1, UP, UP, x),
    "add_gravity": lambda g, x: g.add_gravity(1, x, 0.1),
    "add_velocity": lambda g, x: g.add_velocity(1, x, 1),
    "add_bias": lambda g, x: g.add_bias(1, x, [0, 0, 0], [1] * 6),
    "add_imu samples": lambda g, x: g.add_imu(0, 1, x),
    "add_imu noise": lambda g, x: g.add_imu(0, 1, SAMPLES, x),
    "add_landmark key": lambda g, x: g.add_landmark(x),
    "add_landmark initial": lambda g, x: g.add_landmark(77, x),
    "add_point_observation point": lambda g, x: g.add_point_observation(1, 77, x, sigmas=1),
    "add_point_observation landmark": lambda g, x: g.add_point_observation(1, x, [1, 2, 3], sigmas=1),
    "add_bearing_range bearing": lambda g, x: g.add_bearing_range(1, 77, x, 1, [0.1, 0.1]),
    "add_bearing_range range": lambda g, x: g.add_bearing_range(1, 77, UP, x, [0.1, 0.1]),
    "add_range": lambda g, x: g.add_range(1, 77, x, 0.1),
    "add_range sigma": lambda g, x: g.add_range(1, 77, 1, x),
    "add_bearing": lambda g, x: g.add_bearing(1, 77, x, 0.1),
    "add_bearing sigma": lambda g, x: g.add_bearing(1, 77, UP, x),
    "add_bearing_range sigmas": lambda g, x: g.add_bearing_range(1, 77, UP, 1, x),
    "add_factor residual": lambda g, x: g.add_factor(1, x, 1),
    "add_factor keys": lambda g, x: g.add_factor(x, lambda T: T[:1, 3], 1),
    "add_factor sigmas": lambda g, x: g.add_factor(1, lambda T: T[:1, 3], x),
    "add_factor jacobian": lambda g, x: g.add_factor(1, lambda T: T[:1, 3], 1, x),
    "add_factor result": lambda g, x: g.add_factor(1, lambda _: x, 1),
    "add_gtsam_factor factor": lambda g, x: g.add_gtsam_factor(1, x),
    "add_gtsam_factor keys": lambda g, x: g.add_gtsam_factor(x, _gtsam_prior()),
    "add_altitude": lambda g, x: g.add_altitude(1, x, 1),
    "add_heading": lambda g, x: g.add_heading(1, x, 1),
    "add_body_velocity": lambda g, x: g.add_body_velocity(1, x, 1),
    "add_wheel_speed": lambda g, x: g.add_wheel_speed(1, x, 1, 1),
    "subgraph": lambda g, x: g.subgraph(x),
    "subgraph key": lambda g, x: g.subgraph([x]),
    "set_noise id": lambda g, x: g.set_noise(x, sigmas=1),
    "set_noise sigmas": lambda g, x: g.set_noise(0, sigmas=x),
    "set_measurement id": lambda g, x: g.set_measurement(x, np.eye(4)),
    "set_measurement pose": lambda g, x: g.set_measurement(0, x),
    "marginalise keys": lambda g, x: g.marginalise(x, g.optimize()),
    "marginalise key": lambda g, x: g.marginalise([x], g.optimize()),
    "marginalise solution": lambda g, x: g.marginalise([1], x),
    "add_calibration name": lambda g, x: g.add_calibration(x, "scale", 1, 1),
    "add_calibration kind": lambda g, x: g.add_calibration("new", x, 1, 1),
    "add_calibration stated": lambda g, x: g.add_calibration("new", "extrinsics", x, 1),
    "add_calibration sigmas": lambda g, x: g.add_calibration("new", "lever_arm", None, x),
    "add_gps calibration": lambda g, x: g.add_gps(1, UP, 1, calibration=x),
    "add_imu calibration": lambda g, x: g.add_imu(0, 1, SAMPLES, calibration=x),
    "add_sensor_step calibration": lambda g, x: g.add_sensor_step(0, 1, np.eye(4), x, sigmas=1),
    "solution calibration": lambda g, x: g.optimize().calibration(x),
    "merge graph": lambda g, x: g.merge(x),
    "merge keys": lambda g, x: g.merge(_other(), x),
    "merge pose": lambda g, x: g.merge(_other(), {0: (3, 0)}, x),
    "dimension": lambda _, x: PoseGraph(x),
    "from_gtsam": lambda _, x: PoseGraph.from_gtsam(x, x),
    "online pose": lambda g, x: followed(g).pose(x),
    "online covariance": lambda g, x: followed(g).covariance(x),
    "online relative_covariance": lambda g, x: followed(g).relative_covariance(0, x),
    "online point": lambda g, x: followed(g).point(x),
    "solution pose": lambda g, x: g.optimize().pose(x),
    "solution covariance": lambda g, x: g.optimize().covariance(x),
    "solution point": lambda g, x: g.optimize().point(x),
    "solution residual": lambda g, x: g.optimize().residual(x),
}


def content(graph: PoseGraph) -> tuple[object, ...]:
    """Return everything that a graph holds, to compare: two graphs of equal content are equal to the last bit."""
    poses = [(key, None if (at := graph.initial(key)) is None else at.tobytes()) for key in graph.keys]
    points = [(key, None if (at := graph.initial(key)) is None else at.tobytes()) for key in graph.landmarks]
    noises = {n: f.noise and (f.noise.form, f.noise.values.tobytes()) for n, f in graph.factors.items()}
    factors = [
        (n, f.kind, f.keys, f.landmark, f.measured.tobytes(), f.robust, noises[n]) for n, f in graph.factors.items()
    ]
    return graph.dimension, poses, points, factors, graph.fixed, graph.origin
