"""Initial poses by preintegration, with all samples, with some missing and with none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from inertial import NOISE, at_rest, state_at
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuSamples, Scan
from hybridlio.graph.run.inertial_initial_pose import Preintegration
from hybridlio.graph.run.inertial_steps import InertialSteps

IDENTITY = np.eye(4)


def empty_scan(stamp_ns: int) -> Scan:
    return Scan(stamp_ns, np.empty((0, 3), np.float32))


def straight(steps: int, mount: np.ndarray = IDENTITY) -> tuple[State, Callable[[ImuSamples], Frame]]:
    state = state_at(np.eye(4), np.array([10.0, 0.0, 0.0]), covariance=np.diag(np.full(15, 1e-4)))
    return state, lambda imu: Frame(3, empty_scan(steps * NS_PER_S // 10), imu, calibration=Calibration(mount))


def test_the_predicted_step_is_the_lidars_not_the_imus():
    mount = se3.make(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [1.0, 0.0, 0.5])
    state, frame = straight(1, mount)
    predicted = Preintegration(InertialSteps(Calibration(mount), NOISE)).predict(frame(at_rest(0.0, 0.1)), state)
    np.testing.assert_allclose(predicted.pose, se3.make(np.eye(3), [0.0, -1.0, 0.0]), atol=1e-9)
    assert (predicted.source, predicted.ok, predicted.from_imu) == ("preintegration", True, True)


@pytest.mark.parametrize(
    "imu",
    [ImuSamples.empty(), at_rest(0.0, 0.05), at_rest(0.05, 0.1)],
    ids=["none in this step", "ends early", "starts late"],
)
def test_missing_samples_give_a_constant_velocity_step_that_is_not_ok(imu: ImuSamples):
    state, frame = straight(1)
    source = Preintegration(InertialSteps(Calibration(), NOISE))
    coasted, integrated = source.predict(frame(imu), state), source.predict(frame(at_rest(0.0, 0.1)), state)
    assert not coasted.ok
    assert not coasted.from_imu
    np.testing.assert_allclose(coasted.pose, se3.make(np.eye(3), [1.0, 0.0, 0.0]), atol=1e-12)
    assert (np.diag(coasted.covariance) > np.diag(integrated.covariance)).all()


def test_without_samples_the_last_rate_of_turn_continues():
    mount = se3.make(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [1.0, 0.0, 0.5])
    state, frame = straight(1, mount)
    source = Preintegration(InertialSteps(Calibration(mount), NOISE))
    known = source.predict(frame(at_rest(0.0, 0.1)), state)
    turn = se3.so3_exp([0.01, -0.02, 0.05])
    source.correct(frame(at_rest(0.0, 0.1)), replace(known, pose=se3.make(turn, known.pose[:3, 3])))
    coasted = source.predict(frame(ImuSamples.empty()), state)
    np.testing.assert_allclose(coasted.pose[:3, :3], turn, atol=1e-9)


def test_uncertainty_grows_with_the_time_without_samples():
    source = Preintegration(InertialSteps(Calibration(), NOISE))
    sigmas = []
    for steps in (1, 3, 10):
        state, frame = straight(steps)
        sigmas.append(np.sqrt(np.diag(source.predict(frame(ImuSamples.empty()), state).covariance)))
    assert (np.diff(sigmas, axis=0) > 0).all()


def test_before_the_first_samples_the_last_step_continues_with_one_warning(caplog: pytest.LogCaptureFixture):
    state, frame = straight(1)
    state, blank = replace(state, has_imu=False), frame(ImuSamples.empty())
    source = Preintegration(InertialSteps(Calibration(), NOISE))
    np.testing.assert_array_equal(source.predict(blank, state).pose, np.eye(4))
    moved = RelativePose(se3.exp(np.array([0.0, 0.0, 0.05, 1.0, 0.0, 0.0])), np.eye(6), "test")
    source.correct(blank, moved)
    np.testing.assert_allclose(source.predict(blank, state).pose, moved.pose, atol=1e-12)
    assert [r.getMessage() for r in caplog.records if "no IMU samples so far" in r.getMessage()] == [
        "frame 3: no IMU samples so far; until there are, initial poses by constant velocity"
    ]


def test_samples_are_preintegrated_once_for_equal_inputs_and_again_for_others():
    steps, (state, frame) = InertialSteps(Calibration(), NOISE), straight(1)
    asked = frame(at_rest(0.0, 0.1))
    first = steps.preintegrated(asked, state)
    assert first is not None
    assert steps.preintegrated(replace(asked, index=7), state) is first
    assert steps.preintegrated(replace(asked, imu=at_rest(0.0, 0.1)), replace(state)) is first
    assert steps.predicted(asked, state) is steps.predicted(asked, state)
    other = replace(state, accel_bias_m_s2=np.array([0.1, 0.0, 0.0]))
    assert steps.preintegrated(asked, other) is not first
    faster = replace(asked.imu, gyro_rad_s=np.full((11, 3), 0.01))
    assert steps.preintegrated(replace(asked, imu=faster), state) is not first
    assert steps.preintegrated(asked, replace(state, has_imu=False)) is None
    assert steps.predicted(frame(ImuSamples.empty()), state) is None


def test_over_scans_lost_during_whole_turns_the_prediction_stays_right_and_no_factor_is_made():
    times = np.arange(401) / 100
    rates = np.column_stack([0.3 * np.sin(3 * times), 0.3 * np.cos(2 * times), np.full(401, np.pi)])
    steps = Rotation.from_rotvec((rates[1:] + rates[:-1]) / 200)
    R = [Rotation.identity()]
    for step in steps:
        R.append(R[-1] * step)
    imu = ImuSamples(np.round(times * 1e9).astype(np.int64), rates, Rotation.concatenate(R).inv().apply([0, 0, 9.81]))
    state, frame = straight(40)
    inertial = InertialSteps(Calibration(), NOISE)
    assert inertial.preintegrated(frame(imu), state) is None
    predicted = inertial.predicted(frame(imu), state)
    assert predicted is not None
    assert predicted.from_imu
    error = se3.so3_log(predicted.pose[:3, :3].T @ R[-1].as_matrix())
    assert np.linalg.norm(error) < np.radians(0.1)
