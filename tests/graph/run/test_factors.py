from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, G, V, X
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.graph.base.preintegration import preintegrate
from hybridlio.graph.run import factors
from hybridlio.graph.run.scan_numbers import ScanNumbers

MOUNT = se3.make(Rotation.from_euler("xyz", [2.0, -1.0, 30.0], degrees=True).as_matrix(), [0.8, -0.3, 0.9])
STEP = se3.exp(np.array([0.01, -0.02, 0.05, 1.0, 0.1, -0.02]))


def at_rest(seconds: float) -> ImuSamples:
    stamps = np.arange(0, round(seconds * 1e9) + 1, 10**7)
    return ImuSamples(stamps, np.zeros((len(stamps), 3)), np.tile([0.0, 0.0, 9.81], (len(stamps), 1)))


def start() -> State:
    return start_state(0, at_rest(0.1), ImuNoise())


def relative(**changes: object) -> RelativePose:
    return replace(RelativePose(STEP, np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03]), "test"), **changes)


def between(i: int, j: int, step: RelativePose) -> gtsam.BetweenFactorPose3:
    return factors.between_factor(X(i), X(j), step, step.covariance, MOUNT)


def keys(graph: gtsam.NonlinearFactorGraph) -> list[list[str]]:
    return [[gtsam.DefaultKeyFormatter(k) for k in graph.at(i).keys()] for i in range(graph.size())]  # noqa: SIM118


def test_the_start_has_no_error_and_determines_every_variable():
    graph, values = factors.start_factors(start())
    assert graph.error(values) == pytest.approx(0.0, abs=1e-12)
    marginals = gtsam.Marginals(graph, values)
    np.testing.assert_allclose(marginals.marginalCovariance(V(0)), start().covariance[6:9, 6:9], rtol=1e-6)
    np.testing.assert_allclose(marginals.marginalCovariance(B(0)), start().covariance[9:, 9:], rtol=1e-6)
    assert np.sqrt(marginals.marginalCovariance(X(0)).max()) < 1e-5


def test_gravity_has_an_uncertain_direction_and_a_known_magnitude_even_if_the_direction_is_far_off():
    graph, values = factors.start_factors(start())
    spread = np.sqrt(np.diag(gtsam.Marginals(graph, values).marginalCovariance(G(0))))
    assert spread[2] < 0.04 < 1.0 < spread[0]
    tilted = 9.81 * np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    values.update(G(0), tilted)
    # a vehicle that brakes at 3 m/s²: two of its prior's sigmas
    assert graph.error(values) < 2.5
    values.update(G(0), 1.02 * tilted)
    assert graph.error(values) > 15.0


def test_without_imu_the_start_is_only_a_pose():
    graph, values = factors.start_factors(start_state(0, ImuSamples.empty(), ImuNoise()))
    assert keys(graph) == [["x0"]]
    assert values.size() == 1


def test_a_relative_pose_of_the_lidar_constrains_the_imus_poses():
    T_world_lidar = se3.exp(np.array([0.1, 0.2, -0.3, 4.0, 5.0, 6.0]))
    imu = [gtsam.Pose3(T @ se3.inverse(MOUNT)) for T in (T_world_lidar, T_world_lidar @ STEP)]
    values = gtsam.Values()
    values.insert(X(4), imu[0])
    values.insert(X(5), imu[1])
    assert between(4, 5, relative()).error(values) == pytest.approx(0.0, abs=1e-12)


def test_a_deviation_of_the_lidar_is_weighted_by_the_lidars_covariance_for_any_mount(rng: np.random.Generator):
    xi = 1e-4 * rng.standard_normal(6)
    step = relative()
    factor = between(0, 1, step)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(X(1), gtsam.Pose3(MOUNT @ STEP @ se3.exp(xi) @ se3.inverse(MOUNT)))
    assert factor.error(values) == pytest.approx(xi @ np.linalg.solve(step.covariance, xi) / 2, rel=1e-3)


def test_an_invalid_covariance_raises_an_error_that_names_its_step():
    step = relative()
    object.__setattr__(step, "covariance", -step.covariance)
    with pytest.raises(DataError, match=r"test to scan 4.*not positive definite"):
        between(3, 4, step)


def scans(newest: int, on_map_path: bool = False) -> ScanNumbers:
    """Scans 0 to ``newest``, whose stamps are their numbers; all of them on the map path or none."""
    out = ScanNumbers(0)
    for k in range(1, newest + 1):
        out.add(k, on_map_path)
    if on_map_path and not newest:  # as after a step before scan 0
        out._on_map_path.add(0)
    return out


def step_keys(pim: bool, has_imu: bool = True, starts_path: bool = False, **changes: object) -> list[list[str]]:
    state = replace(start(), has_imu=has_imu)
    pim_of_step = preintegrate(at_rest(0.1), state, ImuNoise()) if pim else None
    return keys(
        factors.step_factors(0, state, relative(**changes), pim_of_step, 10**8, MOUNT, scans(0, not starts_path))
    )


IMU = ["x0", "v0", "x1", "v1", "b0", "b1", "g0"]
SAME_GRAVITY, BETWEEN = ["g0", "g1"], ["x0", "x1"]


def test_a_step_has_a_factor_of_the_samples_and_one_of_the_relative_pose():
    assert step_keys(pim=True) == [IMU, SAME_GRAVITY, BETWEEN]


def test_a_relative_pose_made_from_the_samples_is_left_out():
    assert step_keys(pim=True, from_imu=True) == [IMU, SAME_GRAVITY]


def test_a_failed_relative_pose_is_left_out_where_samples_cover_the_step():
    assert step_keys(pim=True, ok=False) == [IMU, SAME_GRAVITY]


def test_without_samples_even_a_failed_relative_pose_is_used():
    for changes in ({}, {"ok": False}, {"from_imu": True}):
        assert step_keys(pim=False, **changes) == [IMU, SAME_GRAVITY, BETWEEN]
        assert step_keys(pim=False, has_imu=False, **changes) == [BETWEEN]


DRIFT = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])


def test_a_step_with_drift_joins_the_scan_to_the_map_path():
    map_path = [["m0", "m1"], ["m1", "x1"]]
    assert step_keys(pim=True, drift=DRIFT) == [IMU, SAME_GRAVITY, *map_path]
    assert step_keys(pim=True, drift=DRIFT, starts_path=True) == [
        IMU,
        SAME_GRAVITY,
        map_path[0],
        ["m0", "x0"],
        map_path[1],
    ]
    assert step_keys(pim=False, has_imu=False, drift=DRIFT) == map_path


def test_a_failed_step_with_drift_continues_the_map_path_without_constraining_the_scan():
    assert step_keys(pim=True, ok=False, drift=DRIFT) == [IMU, SAME_GRAVITY, ["m0", "m1"]]
    assert step_keys(pim=False, ok=False, drift=DRIFT) == [IMU, SAME_GRAVITY, ["m0", "m1"], BETWEEN]


def test_a_step_with_drift_has_its_claimed_covariance_and_only_drift_adds_up():
    graph, values = factors.start_factors(start_state(0, ImuSamples.empty(), ImuNoise()))
    states = [replace(start(), has_imu=False, T_world_imu=np.linalg.matrix_power(STEP, k)) for k in range(4)]
    marginals, so_far = [], ScanNumbers(0)
    for k in range(3):
        step = relative(drift=0.02 * relative().covariance)
        graph.push_back(factors.step_factors(k, states[k], step, None, 0, np.eye(4), so_far))
        factors.insert_step(values, k, states[k], states[k + 1], step, so_far)
        so_far.add(k + 1, on_map_path=True)
        marginals.append(gtsam.Marginals(graph, values).marginalCovariance(X(k + 1)))
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance([X(2), X(3)]).fullMatrix()
    J = np.hstack([-se3.adjoint(se3.inverse(STEP)), np.eye(6)])
    between_scans = J @ joint @ J.T
    # the drift is rotated a little by the step; half of the scatter is at either end
    np.testing.assert_allclose(np.diag(between_scans), np.diag(relative().covariance), rtol=0.25)
    assert (np.diag(marginals[2])[3:] < 1.3 * np.diag(marginals[0])[3:]).all()


def test_bridged_velocity_may_change_by_the_assumed_acceleration_and_moves_the_pose_with_it():
    before = start_state(0, ImuSamples.empty(), ImuNoise())
    before = replace(before, has_imu=True, velocity_m_s=np.array([10.0, 0.0, 0.0]))
    factor = factors.bridge_factors(0, 1, before, 1.0)[0]

    def error(end_m: float, end_m_s: float) -> float:
        values = gtsam.Values()
        after = replace(before, T_world_imu=se3.exp([0, 0, 0, end_m, 0, 0]), velocity_m_s=np.array([end_m_s, 0.0, 0.0]))
        for k, state in enumerate((before, after)):
            factors.insert_state(values, k, state)
        return float(factor.error(values))

    assert error(10.0, 10.0) == pytest.approx(0.0, abs=1e-6)
    assert error(11.5, 13.0) == pytest.approx(0.5, rel=0.01)  # one sigma: 3 m/s² for a second
    assert error(10.0, 13.0) > 10 * error(11.5, 13.0)  # the speed cannot change without moving the pose
