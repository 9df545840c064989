"""Poses between scans."""

from __future__ import annotations

import numpy as np
import pytest
from streams import MS, events, feed, stream_of, thinned, with_point_times, without_imu

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.datasets.sequence import Sequence
from hybridlio.graph.base.preintegration import predict_step, preintegrate
from hybridlio.odometry.odometry import Odometry


@pytest.fixture(scope="module")
def recording(sequence: Sequence) -> Sequence:
    return with_point_times(thinned(sequence, 4))


def test_predictions_between_scans_follow_the_truth_within_their_covariance(recording):
    assert recording.reference is not None
    stream, errors = stream_of(recording), []
    for event in events(recording):
        done = event.add_to(stream)
        if event.method == "add_scan" and stream.counts.estimates > 5:  # the last estimate is a scan old
            k = int(np.searchsorted(recording.stamps_ns, event.arguments[0]))
            predicted = stream.predict(event.arguments[0])
            error = se3.log(se3.between(predicted.pose, recording.reference.poses[k]))
            errors.append((np.linalg.norm(error[3:]), error @ np.linalg.solve(predicted.covariance, error)))
            assert predicted.from_imu
        del done
    distances, nees = np.array(errors).T
    assert len(errors) > 15
    assert distances.max() < 0.3  # of a metre driven in between
    assert 0.5 < nees.mean() < 12  # 6 expected of independent errors; those of one drive are not


def test_a_prediction_is_preintegration_in_pieces(recording):
    odometry = Odometry(keep_record=False)
    stream = stream_of(recording, odometry=odometry)
    for event in events(recording):
        if event.add_to(stream) and stream.counts.estimates == 12:
            break
    state, calibration = odometry.last_state, recording.calibration
    assert state is not None
    end_ns = state.stamp_ns + 95 * MS
    for e in events(recording):
        if e.method == "add_imu" and e.arguments[0] > event.arguments[0]:
            e.add_to(stream)
    whole = preintegrate(recording.imu.between(state.stamp_ns, end_ns), state, recording.imu_noise or hl.ImuNoise())
    step, _ = predict_step(whole, state)
    T_imu = state.T_world_imu @ step
    expected = se3.inverse(calibration.T_imu_lidar) @ T_imu @ calibration.T_imu_lidar
    at_once = stream.predict(end_ns)
    for t in range(state.stamp_ns, end_ns, 3 * MS):
        stream.predict(t)
    in_pieces = stream.predict(end_ns)
    again = stream.predict(state.stamp_ns)
    np.testing.assert_allclose(at_once.pose, expected, atol=1e-6)
    np.testing.assert_allclose(in_pieces.pose, expected, atol=1e-6)
    np.testing.assert_allclose(at_once.covariance, in_pieces.covariance, rtol=0.05, atol=1e-9)
    np.testing.assert_allclose(again.covariance, stream._prediction.estimate.covariance, rtol=1e-6, atol=1e-12)
    assert np.trace(at_once.covariance) > np.trace(again.covariance)


def test_without_an_imu_the_velocity_continues(recording):
    recording = without_imu(recording)
    stream = stream_of(recording)
    with pytest.raises(hl.HybridLioError, match="before the second estimate"):
        stream.predict(0)
    found = feed(stream, events(recording))
    last, step = found[-1], found[-1].step
    assert step is not None
    predicted = stream.predict(2 * last.stamp_ns - found[-2].stamp_ns)
    np.testing.assert_allclose(predicted.pose, last.pose @ step.pose, atol=1e-9)
    assert not predicted.from_imu
    with pytest.raises(hl.HybridLioError, match="before the last estimate"):
        stream.predict(last.stamp_ns - 1)


def test_a_failed_imu_leaves_predictions_at_constant_velocity(recording):
    stream = stream_of(recording)
    feed(stream, events(recording))
    newest_ns = int(recording.imu.stamps_ns[-1])
    near, far = (stream.predict(newest_ns + ms * MS) for ms in (200, 300))
    assert (near.from_imu, far.from_imu) == (True, False)
    for predicted in (near, far):
        np.linalg.cholesky(predicted.covariance)
