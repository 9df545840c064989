"""The factors of one odometry step, the same for the online and the offline graph.

Keys: ``x`` pose of the IMU, ``v`` velocity, ``b`` biases, ``g`` gravity, ``m`` the pose on the path that scan matching
has made for itself, each with the scan's number. World is the
IMU's first pose, so that a marginal covariance is relative to the start without more ado, and gravity is what is
estimated. It is one vector for all scans, written as a chain of nearly equal ones: a key shared by every factor would
make each update cost as much as the run is long.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, M, V, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import BRIDGED_ACCELERATION_SIGMA_M_S2, GRAVITY_M_S2, GRAVITY_MAGNITUDE_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S
from hybridlio.graph.base import noise
from hybridlio.graph.run.scan_numbers import Scans

Factors = list[gtsam.NonlinearFactor]

VARIABLES = (X, V, B, G, M)  # what a scan may have

_GAUGE_SIGMA = 1e-6  # the first pose defines world
_GRAVITY_CHAIN_SIGMA_M_S2 = 1e-6  # per scan; 0.1 mm/s² after 10,000 scans


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


def between_factor(
    i: int, j: int, relative: RelativePose, covariance: Array, T_imu_lidar: Array
) -> gtsam.BetweenFactorPose3:
    """The relative pose between two keys' IMU poses, given with its covariance between lidar poses."""
    pose = T_imu_lidar @ relative.pose @ se3.inverse(T_imu_lidar)
    model = noise.gaussian(se3.rotate_covariance(covariance, T_imu_lidar), f"{relative.source} to scan {j & 0xFFFFFF}")
    return gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(pose), model)


def map_factors(i: int, relative: RelativePose, drift: Array, T_imu_lidar: Array, fresh: bool) -> Factors:
    """The step from scan ``i`` of a source that matches to a map of its own.

    A scan's scatter about the map is not carried on: the next step takes it back, so that consecutive steps' errors
    are opposed and a chain of independent factors would claim far too much. Instead the source's path has poses of its
    own: along it only the map's drift adds up, and each scan's pose lies beside it by the scatter.

    Args:
        i: the scan before.
        relative: the step; of a failed one, the path goes on where the source put it, but says nothing of the scan.
        drift: ``(6, 6)``, what of its covariance adds up.
        T_imu_lidar: the extrinsics.
        fresh: whether the path begins at scan ``i``.
    """
    graph: Factors = [between_factor(M(i), M(i + 1), relative, drift, T_imu_lidar)]
    if fresh:
        graph.append(gtsam.BetweenFactorPose3(M(i), X(i), gtsam.Pose3(), noise.sigmas(np.full(6, _GAUGE_SIGMA))))
    if relative.ok:
        scatter = se3.rotate_covariance((relative.covariance - drift) / 2, T_imu_lidar)
        model = noise.gaussian(scatter, f"{relative.source}, scatter of scan {i + 1}")
        graph.append(gtsam.BetweenFactorPose3(M(i + 1), X(i + 1), gtsam.Pose3(), model))
    return graph


def earlier_scan_factors(k: int, relative: RelativePose, scans: Scans, T_imu_lidar: Array) -> Factors:
    """Scan ``k`` relative to earlier scans than the last, as far as they are still in the graph.

    All of a scan's relative poses share its noise, be it the newer one or the keyframe. Where the step says how much
    of its covariance is such scatter (``drift`` is the rest), they join the poses on the source's own path, beside
    which the scan's pose lies by the scatter: it is then counted once (:func:`map_factors`). Else they are taken for
    independent of each other.
    """
    on_path = relative.drift is not None and relative.ok
    graph: Factors = []
    for keyframe in relative.earlier_scans:
        j = scans.number(keyframe.stamp_ns)
        if j is not None:
            before = M(j) if on_path and scans.is_on_path(j) else X(j)
            pose = RelativePose(keyframe.pose, keyframe.covariance, relative.source)
            graph.append(between_factor(before, M(k) if on_path else X(k), pose, pose.covariance, T_imu_lidar))
    return graph


def insert_step(
    values: gtsam.Values, i: int, before: State, after: State, relative: RelativePose, scans: Scans
) -> None:
    """Put the variables of the scan after ``i`` in; ``before`` and ``after`` are the states that the two start from.

    The poses of :func:`map_factors` start beside the IMU's.
    """
    insert_state(values, i + 1, after)
    if relative.drift is not None:
        if not scans.is_on_path(i):
            values.insert(M(i), gtsam.Pose3(before.T_world_imu))
        values.insert(M(i + 1), gtsam.Pose3(after.T_world_imu))


def imu_factors(i: int, j: int, pim: gtsam.PreintegratedCombinedMeasurements) -> Factors:
    """The samples between scans i and j as one factor, and gravity carried on."""
    return [
        gtsam.CombinedImuFactorWithGravityVector(X(i), V(i), X(j), V(j), B(i), B(j), G(i), pim),
        _same_gravity(i, j),
    ]


def bridge_factors(i: int, j: int, dt_s: float) -> Factors:
    """In place of IMU samples that are missing: velocity and biases may have changed as much as they can.

    Velocity here is tied to the poses again by the next samples; biases may have walked freely for ``dt_s``.
    """
    no_change = gtsam.imuBias.ConstantBias()
    bias_sigmas = np.r_[np.full(3, 1e-2), np.full(3, 1e-3)] * np.sqrt(dt_s)
    velocity_sigmas = np.full(3, BRIDGED_ACCELERATION_SIGMA_M_S2 * dt_s)
    return [
        gtsam.BetweenFactorVector(V(i), V(j), np.zeros(3), noise.sigmas(velocity_sigmas)),
        gtsam.BetweenFactorConstantBias(B(i), B(j), no_change, noise.sigmas(bias_sigmas)),
        _same_gravity(i, j),
    ]


def _same_gravity(i: int, j: int) -> gtsam.NonlinearFactor:
    model = noise.sigmas(np.full(3, _GRAVITY_CHAIN_SIGMA_M_S2))
    return gtsam.BetweenFactorPoint3(G(i), G(j), np.zeros(3), model)


def step_factors(
    i: int,
    state: State,
    relative: RelativePose,
    pim: gtsam.PreintegratedCombinedMeasurements | None,
    stamp_ns: int,
    T_imu_lidar: Array,
    scans: Scans,
) -> gtsam.NonlinearFactorGraph:
    """All factors of the step from scan ``i`` (at ``state``) to the next, at ``stamp_ns``.

    A relative pose that failed, or that comes from the same IMU samples, is left out where the IMU factor bridges.
    ``scans`` are those in the graph, up to ``i``.
    """
    graph = gtsam.NonlinearFactorGraph()
    if state.has_imu:
        dt_s = (stamp_ns - state.stamp_ns) / NS_PER_S
        for factor in imu_factors(i, i + 1, pim) if pim else bridge_factors(i, i + 1, dt_s):
            graph.add(factor)
    if relative.drift is not None:
        for factor in map_factors(i, relative, relative.drift, T_imu_lidar, fresh=not scans.is_on_path(i)):
            graph.add(factor)
    for factor in earlier_scan_factors(i + 1, relative, scans, T_imu_lidar):
        graph.add(factor)
    usable = relative.ok and not relative.from_imu and relative.drift is None
    if usable or (pim is None and not (relative.ok and relative.drift is not None)):
        graph.add(between_factor(X(i), X(i + 1), relative, relative.covariance, T_imu_lidar))
    return graph
