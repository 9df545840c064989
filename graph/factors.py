"""The factors of one odometry step, the same for the online and the offline graph.

Keys: ``x`` pose of the IMU, ``v`` velocity, ``b`` biases, ``g`` gravity, each with the scan's number. World is the
IMU's first pose, so that a marginal covariance is relative to the start without more ado, and gravity is what is
estimated. It is one vector for all scans, written as a chain of nearly equal ones: a key shared by every factor would
make each update cost as much as the run is long.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from hybridlio import se3
from hybridlio.estimates import Array, RelativePose, State
from hybridlio.graph import noise
from hybridlio.sensors import NS_PER_S
from hybridlio.startup import GRAVITY_M_S2, GRAVITY_MAGNITUDE_SIGMA_M_S2

_GAUGE_SIGMA = 1e-6  # the first pose defines world
_GRAVITY_CHAIN_SIGMA_M_S2 = 1e-6  # per scan; 0.1 mm/s² after 10,000 scans
_BRIDGED_ACCELERATION_M_S2 = 3.0


def start_factors(state: State) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Priors and values of the first scan's variables, from its state."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), noise.sigmas(np.full(6, _GAUGE_SIGMA))))
    insert_state(values, 0, state)
    if state.has_imu:
        bias = values.atConstantBias(B(0))
        velocity_model = noise.gaussian(state.covariance[6:9, 6:9], "start velocity")
        graph.add(gtsam.PriorFactorVector(V(0), state.velocity_m_s, velocity_model))
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, noise.gaussian(state.covariance[9:, 9:], "start biases")))
        gravity_model = noise.gaussian(state.gravity_covariance, "start gravity")
        graph.add(gtsam.PriorFactorPoint3(G(0), state.gravity_m_s2, gravity_model))
        # gravity lies on a sphere, which no Gaussian around a direction that may be 0.3 rad off describes; the first
        # pose is the origin, so that gravity's distance from it is its magnitude
        magnitude = noise.sigmas(np.array([GRAVITY_MAGNITUDE_SIGMA_M_S2]))
        graph.add(gtsam.RangeFactor3D(X(0), G(0), GRAVITY_M_S2, magnitude))
    return graph, values


def insert_state(values: gtsam.Values, k: int, state: State) -> None:
    """Put the state's variables under scan ``k``'s keys."""
    values.insert(X(k), gtsam.Pose3(state.T_world_imu))
    if state.has_imu:
        values.insert(V(k), state.velocity_m_s)
        values.insert(B(k), gtsam.imuBias.ConstantBias(state.accel_bias_m_s2, state.gyro_bias_rad_s))
        values.insert(G(k), state.gravity_m_s2)


def between_factor(i: int, j: int, relative: RelativePose, T_imu_lidar: Array) -> gtsam.BetweenFactorPose3:
    """The relative pose of scan j in scan i as a factor between IMU poses."""
    pose = T_imu_lidar @ relative.pose @ se3.inverse(T_imu_lidar)
    model = noise.gaussian(se3.rotate_covariance(relative.covariance, T_imu_lidar), f"{relative.source} {i}-{j}")
    return gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(pose), model)


def imu_factors(i: int, j: int, pim: gtsam.PreintegratedCombinedMeasurements) -> list[gtsam.NonlinearFactor]:
    """The samples between scans i and j as one factor, and gravity carried on."""
    return [
        gtsam.CombinedImuFactorWithGravityVector(X(i), V(i), X(j), V(j), B(i), B(j), G(i), pim),
        _same_gravity(i, j),
    ]


def bridge_factors(i: int, j: int, dt_s: float) -> list[gtsam.NonlinearFactor]:
    """In place of IMU samples that are missing: velocity and biases may have changed as much as they can.

    Velocity here is tied to the poses again by the next samples; biases may have walked freely for ``dt_s``.
    """
    no_change = gtsam.imuBias.ConstantBias()
    bias_sigmas = np.r_[np.full(3, 1e-2), np.full(3, 1e-3)] * np.sqrt(dt_s)
    velocity_sigmas = np.full(3, _BRIDGED_ACCELERATION_M_S2 * dt_s)
    return [
        gtsam.BetweenFactorVector(V(i), V(j), np.zeros(3), noise.sigmas(velocity_sigmas)),
        gtsam.BetweenFactorConstantBias(B(i), B(j), no_change, noise.sigmas(bias_sigmas)),
        _same_gravity(i, j),
    ]


def _same_gravity(i: int, j: int) -> gtsam.NonlinearFactor:
    model = noise.sigmas(np.full(3, _GRAVITY_CHAIN_SIGMA_M_S2))
    return gtsam.BetweenFactorPoint3(G(i), G(j), np.zeros(3), model)


def step_factors(
    i: int, state: State, relative: RelativePose, pim: gtsam.PreintegratedCombinedMeasurements | None, stamp_ns: int,
    T_imu_lidar: Array,
) -> gtsam.NonlinearFactorGraph:  # fmt: skip
    """All factors of the step from scan ``i`` (at ``state``) to the next, at ``stamp_ns``.

    A relative pose that failed, or that comes from the same IMU samples, is left out where the IMU factor bridges.
    """
    graph = gtsam.NonlinearFactorGraph()
    if state.has_imu:
        dt_s = (stamp_ns - state.stamp_ns) / NS_PER_S
        for factor in imu_factors(i, i + 1, pim) if pim else bridge_factors(i, i + 1, dt_s):
            graph.add(factor)
    if pim is None or (relative.ok and not relative.from_imu):
        graph.add(between_factor(i, i + 1, relative, T_imu_lidar))
    return graph
