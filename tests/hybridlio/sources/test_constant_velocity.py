import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import changed_motion_covariance, unknown_motion_covariance
from hybridlio.core.sensors import Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.sources.constant_velocity import ConstantVelocity, Identity
from hybridlio.sources.residual_chain import NoResidual

TWIST = np.array([0.01, -0.02, 0.3, 10.0, 0.5, -0.1])  # per second


def state_at(seconds: float) -> State:
    return start_state(round(seconds * 1e9), ImuSamples.empty(), ImuNoise())


def frame_at(seconds: float) -> Frame:
    return Frame(1, Scan(round(seconds * 1e9), np.empty((0, 3), np.float32)))


def step(seconds: float) -> RelativePose:
    return RelativePose(se3.exp(TWIST * seconds), np.eye(6) * 1e-4, "test")


def test_a_steady_motion_is_continued_over_steps_of_any_duration():
    source = ConstantVelocity()
    source.predict(frame_at(0.1), state_at(0.0))
    source.correct(frame_at(0.1), step(0.1))
    for start, end in ((0.1, 0.2), (0.2, 0.5), (0.5, 0.51)):
        predicted = source.predict(frame_at(end), state_at(start))
        np.testing.assert_allclose(predicted.pose, se3.exp(TWIST * (end - start)), atol=1e-9)
        source.correct(frame_at(end), step(end - start))


def test_constant_velocity_starts_with_an_unknown_motion():
    first = ConstantVelocity().predict(frame_at(0.1), state_at(0.0))
    np.testing.assert_array_equal(first.pose, np.eye(4))
    np.testing.assert_array_equal(first.covariance, unknown_motion_covariance(0.1))


def test_a_known_step_narrows_the_next_prediction():
    source = ConstantVelocity()
    unsure = source.predict(frame_at(0.1), state_at(0.0)).covariance
    source.correct(frame_at(0.1), step(0.1))
    sure = source.predict(frame_at(0.2), state_at(0.1)).covariance
    assert (np.diag(sure) < 0.05 * np.diag(unsure)).all()


def test_the_unknown_motion_covers_a_motorway_and_the_changed_one_an_emergency_stop():
    unknown, changed = (np.sqrt(np.diag(c(0.1))) for c in (unknown_motion_covariance, changed_motion_covariance))
    assert 3 * unknown[3] > 4.0  # 40 m/s for 0.1 s
    assert 3 * unknown[2] > 0.06  # 35 °/s
    assert 3 * changed[3] > 0.05  # a change of 5 m/s² over 0.1 s
    assert (changed < unknown).all()


def test_uncertainty_grows_with_time_from_above_zero():
    for covariance in (unknown_motion_covariance, changed_motion_covariance):
        sigmas = np.array([np.diag(covariance(dt)) for dt in (0.0, 0.05, 0.1, 1.0)])
        assert (np.diff(sigmas, axis=0) > 0).all()
        assert (sigmas[0] > 0).all()


def test_identity_ignores_corrections():
    source = Identity()
    source.correct(frame_at(0.1), step(0.1))
    np.testing.assert_array_equal(source.predict(frame_at(0.2), state_at(0.1)).pose, np.eye(4))


def test_no_residual_returns_the_initial_pose():
    source, initial = NoResidual(), step(0.1)
    source.start(frame_at(0.0))
    assert source.refine(frame_at(0.1), initial) is initial
