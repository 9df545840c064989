"""The factors of one odometry step, the same online and in offline smoothing.

Keys, each with the scan's number: ``x`` pose of the IMU, ``v`` velocity, ``b`` biases, ``g`` gravity, ``m`` pose on the
map path (:func:`map_path_factors`). World is the IMU's first pose, so that marginal covariances of poses are relative
to the start, and gravity is estimated in that frame. Gravity is one vector for all scans, but modelled as a chain of
nearly equal ones: a key that every factor shares would make each iSAM2 update as expensive as the run is long.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, M, V, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import GRAVITY_M_S2, GRAVITY_MAGNITUDE_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S
from hybridlio.graph.base import noise
from hybridlio.graph.base.preintegration import preintegrate_unknown
from hybridlio.graph.run.scan_numbers import ScanNumbers

Factors = list[gtsam.NonlinearFactor]

VARIABLES = (X, V, B, G, M)  # that a scan may have

# Tight enough to define the origin, far below the floors of any measurement (5e-5 rad, 1e-3 m), and loose enough for
# double precision.
_GAUGE_SIGMA = 1e-6
_GRAVITY_CHAIN_SIGMA_M_S2 = 1e-6  # per scan; 0.1 mm/s² after 10,000 scans, so gravity stays one vector
_INDEX_MASK = 0xFFFFFF  # of a GTSAM key: the scan's number, without the letter


def start_factors(state: State) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return priors and values of the first scan's variables, from its state."""
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
        # Gravity lies on a sphere. A Gaussian that is tight along the initial direction describes the sphere badly when
        # that direction is 0.3 rad off (a start in a bend), so the magnitude is a factor of its own: the first pose is
        # the origin, and gravity's distance from the origin is its magnitude.
        magnitude = noise.sigmas(np.array([GRAVITY_MAGNITUDE_SIGMA_M_S2]))
        graph.add(gtsam.RangeFactor3D(X(0), G(0), GRAVITY_M_S2, magnitude))
    return graph, values


def insert_state(values: gtsam.Values, k: int, state: State) -> None:
    """Insert the state's variables under scan ``k``'s keys."""
    values.insert(X(k), gtsam.Pose3(state.T_world_imu))
    if state.has_imu:
        values.insert(V(k), state.velocity_m_s)
        values.insert(B(k), gtsam.imuBias.ConstantBias(state.accel_bias_m_s2, state.gyro_bias_rad_s))
        values.insert(G(k), state.gravity_m_s2)


def between_factor(
    i: int, j: int, relative: RelativePose, covariance: Array, T_imu_lidar: Array
) -> gtsam.BetweenFactorPose3:
    """Return a between-factor of two IMU poses from a relative pose of the lidar.

    Args:
        i, j: keys of the poses.
        relative: ``T_i_j`` of the lidar.
        covariance: ``(6, 6)`` of it, of a right perturbation in the lidar's frame.
        T_imu_lidar: ``(4, 4)``.
    """
    pose = T_imu_lidar @ relative.pose @ se3.inverse(T_imu_lidar)
    name = f"{relative.source} to scan {j & _INDEX_MASK}"
    model = noise.gaussian(se3.rotate_covariance(covariance, T_imu_lidar), name)
    return gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(pose), model)


def map_path_factors(i: int, relative: RelativePose, drift: Array, T_imu_lidar: Array, starts_path: bool) -> Factors:
    """Return the factors of the step from scan ``i``, of a source that registers scans to a map of its own.

    A scan's scatter about the map does not add up: the next step takes it back, so errors of consecutive steps are
    anticorrelated, and a chain of independent factors would claim far too large covariances. Instead the source's path
    through its map has poses ``m`` of its own: along it only the map's drift adds up, and each scan's pose ``x`` lies
    beside it by the scatter.

    Args:
        i: the scan before.
        relative: the step; a failed one continues the path but does not constrain the scan's pose.
        drift: ``(6, 6)`` part of its covariance that adds up.
        T_imu_lidar: ``(4, 4)``.
        starts_path: whether the path begins at scan ``i``.
    """
    graph: Factors = [between_factor(M(i), M(i + 1), relative, drift, T_imu_lidar)]
    if starts_path:
        graph.append(gtsam.BetweenFactorPose3(M(i), X(i), gtsam.Pose3(), noise.sigmas(np.full(6, _GAUGE_SIGMA))))
    if relative.ok:
        # a step's scatter is that of both its scans, half each
        scatter = se3.rotate_covariance((relative.covariance - drift) / 2, T_imu_lidar)
        model = noise.gaussian(scatter, f"{relative.source}, scatter of scan {i + 1}")
        graph.append(gtsam.BetweenFactorPose3(M(i + 1), X(i + 1), gtsam.Pose3(), model))
    return graph


def earlier_scan_factors(k: int, relative: RelativePose, scans: ScanNumbers, T_imu_lidar: Array) -> Factors:
    """Return factors of scan ``k``'s poses relative to earlier scans than the last, if these are in the graph.

    All relative poses of a scan share that scan's noise. If the step tells this scatter apart (``drift`` is the rest),
    the factors join poses on the map path, beside which the scan's pose lies by the scatter, so it counts once
    (:func:`map_path_factors`). Otherwise they are taken as independent of each other.
    """
    on_path = relative.drift is not None and relative.ok
    graph: Factors = []
    for earlier in relative.earlier_scans:
        j = scans.number(earlier.stamp_ns)
        if j is not None:
            start = M(j) if on_path and scans.is_on_map_path(j) else X(j)
            pose = RelativePose(earlier.pose, earlier.covariance, relative.source)
            graph.append(between_factor(start, M(k) if on_path else X(k), pose, pose.covariance, T_imu_lidar))
    return graph


def insert_step(
    values: gtsam.Values, i: int, before: State, after: State, relative: RelativePose, scans: ScanNumbers
) -> None:
    """Insert initial values for the step from scan ``i``: the next scan's variables, and poses on the map path.

    Args:
        values: to insert into.
        i: the scan before.
        before, after: states that the two scans' poses on the map path start from.
        relative: the step.
        scans: those in the graph, up to ``i``.
    """
    insert_state(values, i + 1, after)
    if relative.drift is not None:
        if not scans.is_on_map_path(i):
            values.insert(M(i), gtsam.Pose3(before.T_world_imu))
        values.insert(M(i + 1), gtsam.Pose3(after.T_world_imu))


def imu_factors(i: int, j: int, pim: gtsam.PreintegratedCombinedMeasurements) -> Factors:
    """Return the preintegrated samples between scans ``i`` and ``j`` as a factor, and gravity's link of the chain."""
    return [
        gtsam.CombinedImuFactorWithGravityVector(X(i), V(i), X(j), V(j), B(i), B(j), G(i), pim),
        _same_gravity(i, j),
    ]


def bridge_factors(i: int, j: int, state: State, dt_s: float) -> Factors:
    """Return the factors of a step without IMU samples, over which velocity and biases may change freely.

    The velocity stays tied to the poses: after a gap, one that had only been carried over would be wrong by all that
    the vehicle braked or accelerated, and the first samples would pull the poses after it.
    """
    return imu_factors(i, j, preintegrate_unknown(state, dt_s))


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
    scans: ScanNumbers,
) -> gtsam.NonlinearFactorGraph:
    """Return all factors of the step from scan ``i`` to the next.

    A relative pose that failed, or that was made from the same IMU samples, becomes no factor where the IMU factor
    bridges the step; without samples, any relative pose is better than none.

    Args:
        i: the scan before.
        state: at scan ``i``.
        relative: the step.
        pim: preintegrated samples of the step; None where they do not cover it.
        stamp_ns: of the next scan.
        T_imu_lidar: ``(4, 4)``.
        scans: those in the graph, up to ``i``.
    """
    graph = gtsam.NonlinearFactorGraph()
    if state.has_imu:
        dt_s = (stamp_ns - state.stamp_ns) / NS_PER_S
        for factor in imu_factors(i, i + 1, pim) if pim else bridge_factors(i, i + 1, state, dt_s):
            graph.add(factor)
    if relative.drift is not None:
        starts_path = not scans.is_on_map_path(i)
        for factor in map_path_factors(i, relative, relative.drift, T_imu_lidar, starts_path):
            graph.add(factor)
    for factor in earlier_scan_factors(i + 1, relative, scans, T_imu_lidar):
        graph.add(factor)
    usable = relative.ok and not relative.from_imu and relative.drift is None
    if usable or (pim is None and not (relative.ok and relative.drift is not None)):
        graph.add(between_factor(X(i), X(i + 1), relative, relative.covariance, T_imu_lidar))
    return graph
