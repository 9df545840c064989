"""The LSTMs at run time."""

import numpy as np
import pytest
from stand_ins import WIDE, frame

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.learned.source_settings import LstmSettings
from hybridlio.learned.sources.lstm_initial_pose import LstmInitialPose


def state() -> State:
    three = np.zeros(3)
    return State(0, np.eye(4), three, three, three, three, np.eye(15), np.eye(3))


def test_lstm_covariance_follows_prediction_errors(weights):
    lstm = LstmInitialPose(LstmSettings(str(weights())))
    first = lstm.predict(frame(1), state())
    assert first.from_imu
    assert np.array_equal(first.pose, LstmInitialPose(LstmSettings(str(weights()))).predict(frame(1), state()).pose)
    for _ in range(200):
        predicted = lstm.predict(frame(1), state())
        lstm.correct(frame(1), RelativePose(predicted.pose @ se3.exp([0, 0, 0, 0.05, 0, 0]), WIDE, source="truth"))
    sigmas = np.sqrt(np.diag(lstm.predict(frame(1), state()).covariance))
    assert sigmas[3] == pytest.approx(0.05, rel=0.01)
    assert sigmas[4] < 0.01


def test_without_samples_the_prediction_is_marked_as_failed(weights):
    found = LstmInitialPose(LstmSettings(str(weights()))).predict(frame(1, imu=False), state())
    assert not found.ok
    assert found.covariance[3, 3] > 1.0


def test_a_velocity_conditioned_lstm_continues_at_the_last_velocity(weights):
    lstm = LstmInitialPose(LstmSettings(str(weights(velocity=True))))
    still = lstm.predict(frame(1), state()).pose
    lstm.correct(frame(1), RelativePose(se3.exp([0, 0, 0, 1.0, 0, 0]), WIDE, source="truth"))
    assert lstm.predict(frame(1), state()).pose[0, 3] - still[0, 3] == pytest.approx(1.0, abs=0.3)


def test_weights_that_predict_no_initial_pose_are_refused(weights):
    with pytest.raises(ConfigError, match="none"):
        LstmInitialPose(LstmSettings(str(weights(imu="none"))))
