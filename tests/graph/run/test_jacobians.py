"""The Jacobian of each kind of factor against central differences of its whitened residual.

Steps are along GTSAM's tangent vectors (``Values.retract``), at values that fit the measurement and at values far from
it. Entries agree to ``TOLERANCE`` of the largest in their row; the differences are accurate to about 1e-9. Robust
kernels are left out: they reweight residuals and have no exact Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import G, M, X

from hybridlio.core import se3
from hybridlio.core.estimates import EarlierScanPose, RelativePose
from hybridlio.core.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.graph import PoseGraph
from hybridlio.graph.base.preintegration import preintegrate
from hybridlio.graph.model.coordinates import from_matrices
from hybridlio.graph.run import factors
from hybridlio.graph.run.gps_factors import GpsGroup, _plumb_factor
from hybridlio.graph.run.scan_numbers import ScanNumbers
from hybridlio.graph.solve.builder import Builder

STEP = 1e-5
TOLERANCE = 1e-8
OFF = 0.3  # rad, m, m/s: how far from fitting values the second check is

Case = tuple[list[Any], gtsam.Values]


def samples(rng: np.random.Generator, count: int = 11) -> ImuSamples:
    accel = np.tile([0.3, -0.2, 9.81], (count, 1)) + 0.5 * rng.standard_normal((count, 3))
    return ImuSamples(np.arange(count) * 10_000_000, 0.3 * rng.standard_normal((count, 3)), accel)


def pose(rng: np.random.Generator, dimension: int = 3) -> np.ndarray:
    xi = rng.normal(size=6) * [0.8, 0.8, 0.8, 4.0, 4.0, 4.0]
    return se3.exp(xi if dimension == 3 else np.r_[0, 0, xi[2:5], 0])


def covariance(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return 0.01 * (root @ root.T + 0.1 * np.eye(size))


def pose_graph(dimension: int) -> Case:
    """Poses that fit their priors and between-factors, and every other kind of factor of that dimension."""
    rng = np.random.default_rng(7)
    graph, size = PoseGraph(dimension), 6 if dimension == 3 else 3
    poses = [pose(rng, dimension) for _ in range(3)]
    graph.add_prior(0, poses[0], covariance(rng, size))
    graph.add_between(0, 1, se3.between(poses[0], poses[1]), information=covariance(rng, size))
    graph.add_between(1, 2, se3.between(poses[1], poses[2]), sigmas=rng.uniform(0.1, 1.0, size))
    graph.set_initial(0, poses[0])
    graph.fix(0)
    if dimension == 3:
        graph.add_gps(1, poses[1][:3, 3] + 1.0, [0.1, 0.2, 0.3], [0.5, -0.4, 1.2])
        graph.add_gps_geodetic(2, 49.0, 8.4, 110.0, covariance=covariance(rng, 3), lever_arm_m=[0.5, -0.4, 1.2])
        graph.add_attitude(1, rng.normal(size=3), rng.normal(size=3), 0.1)
        graph.add_gravity(2, [0.5, 0.3, 9.8], 0.1)
        graph.add_velocity(1, rng.normal(size=3), sigmas=0.3)
        graph.add_imu(1, 2, samples(rng))
        graph.add_bias(1, 0.1 * rng.normal(size=3), 0.01 * rng.normal(size=3), sigmas=0.2)
        graph.add_imu(0, 1, samples(rng))
    add_calibrated(graph, rng)
    builder = Builder(graph._data)
    made, values = builder.graph(), builder.values(from_matrices(np.array(poses), graph.dimension))
    return [made.at(k) for k in range(made.size())], values


def add_calibrated(graph: PoseGraph, rng: np.random.Generator) -> None:
    """Add every kind of factor that depends on calibration variables."""
    size, of_pose = graph.dimension, 6 if graph.dimension == 3 else 3
    graph.add_calibration("mount", "extrinsics", pose(rng, size), sigmas=0.3)
    graph.add_calibration("scale", "scale", 1.2, sigmas=0.1)
    graph.add_calibration("arm", "lever_arm", rng.normal(size=size), sigmas=0.1)
    steps, fixes = ["mount", "scale"], ["arm"]
    if size == 3:
        graph.add_calibration("clock", "time_offset", 0.1, sigmas=0.1)
        graph.add_calibration("biases", "bias", 0.1 * rng.normal(size=6), sigmas=0.1)
        graph.add_calibration("down", "gravity", rng.normal(size=3), sigmas=0.1)
        graph.add_velocity(2, rng.normal(size=3), sigmas=0.3)
        steps, fixes = [*steps, "clock"], [*fixes, "clock"]
        for names in ("biases", "down", ["biases", "down"]):
            graph.add_imu(1, 2, samples(rng), calibration=names)
        graph.add_gps(1, rng.normal(size=3), 0.2, calibration="arm")
    graph.add_sensor_step(1, 2, pose(rng, size), steps, covariance(rng, of_pose))
    graph.add_gps(1, rng.normal(size=size), 0.2, calibration=fixes)
    graph.add_gps(2, rng.normal(size=size), 0.2, rng.normal(size=size))
    graph.add_gps(2, rng.normal(size=size), 0.2)


def odometry() -> Case:
    """A start, then every kind of step: samples, a bridge, a relative pose, the map path, an earlier scan."""
    rng = np.random.default_rng(8)
    begin = start_state(0, samples(rng), ImuNoise())
    after = [replace(begin, stamp_ns=100_000_000 * k, T_world_imu=pose(rng)) for k in (1, 2)]
    graph, values = factors.start_factors(begin)
    made = [graph.at(k) for k in range(graph.size())]
    for k, state in enumerate(after, 1):
        factors.insert_state(values, k, state)
    states, mount = [begin, *after], pose(rng)
    for k in range(2):
        values.insert(M(k), gtsam.Pose3(states[k].T_world_imu))
    step = se3.between(*(states[k].T_world_imu @ mount for k in (0, 1)))
    relative = RelativePose(step, covariance(rng, 6), "test")
    made.append(factors.between_factor(X(0), X(1), relative, relative.covariance, mount))
    made += factors.map_path_factors(0, relative, 0.3 * relative.covariance, mount, starts_path=True)
    scans = ScanNumbers(begin.stamp_ns)
    for state in after:
        scans.add(state.stamp_ns, on_map_path=False)
    to_first = se3.between(begin.T_world_imu @ mount, after[1].T_world_imu @ mount)
    earlier = (EarlierScanPose(begin.stamp_ns, to_first, covariance(rng, 6)),)
    made += factors.earlier_scan_factors(2, replace(relative, earlier_scans=earlier), scans, mount)
    made += factors.imu_factors(0, 1, preintegrate(samples(rng), begin, ImuNoise()))
    made += factors.bridge_factors(1, 2, after[0], 0.1)
    return made, values


def fixes(chain: Callable[..., Any]) -> Case:
    """Factors of fixes of an antenna beside the IMU, with a clock of their own."""
    drive = chain(51, steps=60)
    stamps = np.array([frame.scan.stamp_ns for frame in drive.frames])
    states = [
        replace(drive.start, stamp_ns=int(t), T_world_imu=T, velocity_m_s=v)
        for t, T, v in zip(stamps, drive.poses, drive.velocities, strict=True)
    ]
    lever, T_enu_world = np.array([-0.4, 0.6, 1.1]), se3.exp([0.0, 0.0, 2.0, 30.0, -20.0, 4.0])
    placed = (T_enu_world @ drive.poses @ se3.make(np.eye(3), lever))[:, :3, 3]
    given = tuple(GpsFix(int(stamps[k]) - 20_000_000, placed[k], 0.09 * np.eye(3)) for k in range(2, 58, 4))
    calibration = Calibration(drive.calibration.T_imu_lidar, antenna_imu_m=lever)
    record = replace(drive.record(drive.lidar_poses), gps=given, calibration=calibration)
    group = GpsGroup(record).build(states, None)
    values = gtsam.Values(group.values)
    for k, state in enumerate(states):
        values.insert(X(k), gtsam.Pose3(state.T_world_imu))
    values.insert(G(0), drive.gravity)
    without_imu = _plumb_factor(start_state(0, ImuSamples.empty(), ImuNoise()))
    return [*group.trusted, *(one.factor() for one in group.possible_outliers), without_imu], values


def whitened(factor: Any, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and residual."""
    jacobian, negative = factor.linearize(values).jacobian()
    return jacobian, -negative


def differences(factor: Any, values: gtsam.Values) -> np.ndarray:
    columns = []
    for key in factor.keys():  # noqa: SIM118
        for step in STEP * np.eye(len(values.zeroVectors().at(key))):
            ends = []
            for sign in (1, -1):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * step)
                ends.append(whitened(factor, values.retract(delta))[1])
            columns.append((ends[0] - ends[1]) / (2 * STEP))
    return np.column_stack(columns)


def only(values: gtsam.Values, keys: list[int]) -> gtsam.Values:
    """A copy of the values of some keys, so that retracting it is fast."""
    some = gtsam.Values(values)
    for key in set(values.keys()) - set(keys):
        some.erase(key)
    return some


def moved(values: gtsam.Values, rng: np.random.Generator) -> gtsam.Values:
    delta = gtsam.VectorValues()
    for key in values.keys():  # noqa: SIM118
        delta.insert(key, OFF * rng.standard_normal(len(values.zeroVectors().at(key))))
    return values.retract(delta)


KINDS = {
    "pose graph in space": {
        "PriorFactorPose3", "BetweenFactorPose3", "GPSFactorArm", "AttitudeFactorPose3", "PriorFactorVector",
        "CombinedImuFactor", "PriorFactorConstantBias", "ImuFactor", "ImuFactorWithGravityDirection", "CustomFactor",
        "CombinedImuFactorWithGravityDirection", "GPSFactorArmCalib", "PriorFactorPoint3", "PriorFactorUnit3",
    },
    "pose graph in the plane": {
        "PriorFactorPose2", "BetweenFactorPose2", "CustomFactor", "PoseTranslationPrior2D", "PriorFactorPoint2",
        "PriorFactorPoint3",
        "PriorFactorVector",
    },
    "odometry": {
        "PriorFactorPose3", "PriorFactorVector", "PriorFactorConstantBias", "PriorFactorPoint3", "RangeFactor3D",
        "BetweenFactorPose3", "CombinedImuFactorWithGravityVector", "BetweenFactorPoint3",
    },
    "fixes": {
        "PriorFactorPose3", "PriorFactorVector", "CustomFactor", "LinearContainerFactor",
        "ReferenceFrameFactorPoint3Pose3", "PriorFactorPoint3", "AttitudeFactorPose3",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def cases(chain: Callable[..., Any]) -> dict[str, Case]:
    return dict(zip(KINDS, (pose_graph(3), pose_graph(2), odometry(), fixes(chain)), strict=True))


@pytest.mark.parametrize("where", ["at values that fit", "far from them"])
@pytest.mark.parametrize("case", KINDS)
def test_the_jacobian_of_every_factor_agrees_with_differences(cases, case, where):
    made, values = cases[case]
    rng = np.random.default_rng(9)
    assert {type(factor).__name__ for factor in made} == KINDS[case]
    for factor in made:
        here = only(values, factor.keys())
        here = here if where == "at values that fit" else moved(here, rng)
        numeric = differences(factor, here)
        apart = np.abs(whitened(factor, here)[0] - numeric) / np.abs(numeric).max(axis=1, keepdims=True)
        assert apart.max() < TOLERANCE, f"{type(factor).__name__}: {apart.max():.1e} apart"


def test_the_error_is_half_the_squared_whitened_residual(cases):
    """Central differences must be of the error that the solver minimises."""
    for made, values in cases.values():
        here = moved(values, np.random.default_rng(10))
        for factor in made:
            _, residual = whitened(factor, here)
            assert factor.error(here) == pytest.approx(residual @ residual / 2, rel=1e-9, abs=1e-12)


def test_a_wrong_jacobian_is_detected():
    def error(_: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        z = values.atVector(G(0))
        if jacobians is not None:
            jacobians[0] = np.diag(2.0 * z + [0.0, 1e-6, 0.0])
        return z**2

    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [G(0)], error)
    values = gtsam.Values()
    values.insert(G(0), np.array([1.0, 2.0, 3.0]))
    apart = np.abs(whitened(factor, values)[0] - differences(factor, values))
    assert apart.max() > TOLERANCE * 6.0
