"""The residual network at run time."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from stand_ins import FEW, STEP, WIDE, frame

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.learned.sources.network_residual import NetworkResidual

OFF = np.array([0.003, -0.002, 0.004, 0.06, -0.05, 0.03])


def source(weights_path, scans, settings=FEW) -> NetworkResidual:
    settings = replace(settings, weights=str(weights_path))
    residual = NetworkResidual(lambda _: lambda scan: scans[scan.stamp_ns // 10**8], settings)
    residual.start(frame(0))
    return residual


def initial(error: np.ndarray) -> RelativePose:
    return RelativePose(STEP @ se3.exp(error), WIDE, source="guess", from_imu=True)


def test_refinement_finds_the_pose_and_the_covariance_covers_its_error(weights, seen):
    path, normalised = weights(), []
    for seed in range(4):
        scans = [seen(np.eye(4), seed=2 * seed), seen(STEP, seed=2 * seed + 1)]
        found = source(path, scans, replace(FEW, refine_steps=8)).refine(frame(1), initial(OFF))
        assert found.ok
        assert found.source == "network"
        assert found.degenerate.shape == (0, 6)
        assert found.details["cost"] < found.details["initial_cost"]
        error = se3.log(se3.between(STEP, found.pose))
        assert np.abs(error[:3]).max() < 1e-3
        assert np.abs(error[3:]).max() < 0.01
        normalised.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert np.mean(normalised) < 2.0


def test_the_network_is_asked_as_often_as_the_settings_say(weights, seen):
    path, scans = weights(iterations=2), [seen(np.eye(4))]
    assert [source(path, scans, replace(FEW, iterations=n))._network.settings.iterations for n in (0, 3)] == [2, 3]


def test_along_a_corridor_the_covariance_is_large_and_the_direction_listed_as_degenerate(weights, seen):
    half = (500.0, 3.0, 2.0)
    scans = [seen(np.eye(4), half, seed=0), seen(STEP, half, seed=1)]
    found = source(weights(), scans, replace(FEW, refine_steps=8)).refine(frame(1), initial(OFF))
    assert found.ok
    along = STEP[:3, :3].T @ [1.0, 0.0, 0.0]  # in the current scan's axes, as right perturbations are
    assert np.abs(found.degenerate @ np.r_[0, 0, 0, along]).max() > 0.99
    in_corridor = STEP[:3, :3] @ found.covariance[3:, 3:] @ STEP[:3, :3].T
    sigmas = np.sqrt(np.diag(in_corridor))
    assert sigmas[0] > 100 * sigmas[1]
    # refinement does not diverge along it either
    assert abs(se3.log(se3.between(STEP, found.pose))[3]) < 0.1


def answering(residual, pose, monkeypatch):
    """Replace the network's answer."""
    answer = type("Answer", (), {"pose": torch.tensor(pose, dtype=torch.float32)[None]})
    monkeypatch.setattr(residual._network, "refine_encoded", lambda *_: answer)


def test_an_answer_of_higher_loss_is_rejected_and_the_reason_logged(weights, seen, monkeypatch, caplog):
    residual = source(weights(), [seen(np.eye(4), seed=0), seen(STEP, seed=1)], replace(FEW, refine_steps=0))
    answering(residual, STEP @ se3.exp(3 * OFF), monkeypatch)
    found = residual.refine(frame(1), initial(OFF))
    assert not found.ok
    assert np.allclose(found.pose, initial(OFF).pose)
    assert np.array_equal(found.covariance, WIDE)
    assert found.details["cost"] > found.details["initial_cost"]
    assert "frame 1: bridged by the initial pose: network: the loss of the answer is higher" in caplog.text


def test_refinement_corrects_a_bad_answer_and_keeps_a_good_one(weights, seen, monkeypatch):
    scans = [seen(np.eye(4), seed=0), seen(STEP, seed=1)]
    for error, mended in ((3 * OFF, True), (np.zeros(6), False)):
        residual = source(weights(), scans, replace(FEW, refine_steps=8))
        answering(residual, STEP @ se3.exp(error), monkeypatch)
        found = residual.refine(frame(1), initial(OFF))
        assert found.ok
        assert found.details["refined"] == mended
        off = se3.log(se3.between(STEP, found.pose))
        assert np.abs(off[3:]).max() < (0.01 if mended else 1e-6)


def test_the_distance_to_the_minimum_of_the_loss_enters_the_covariance(weights, seen, monkeypatch):
    scans = [seen(np.eye(4), seed=0), seen(STEP, seed=1)]
    sigmas = []
    for error in (np.zeros(6), OFF):
        residual = source(weights(), scans, replace(FEW, refine_steps=0))
        answering(residual, STEP @ se3.exp(error), monkeypatch)
        found = residual.refine(frame(1), initial(2 * OFF))
        off = se3.log(se3.between(found.pose, STEP))
        assert off @ np.linalg.solve(found.covariance, off) < 16.8
        sigmas.append(np.sqrt(found.covariance[3, 3]))
    assert sigmas[1] > 3 * sigmas[0]


def test_along_a_corridor_the_initial_pose_is_kept_whatever_the_network_answers(weights, seen, monkeypatch):
    half = (500.0, 3.0, 2.0)
    residual = source(weights(), [seen(np.eye(4), half, seed=0), seen(STEP, half, seed=1)])
    answering(residual, se3.exp([0, 0, 0, 0.5, 0, 0]) @ STEP, monkeypatch)  # half a metre along it
    found = residual.refine(frame(1), initial(OFF))
    assert found.ok
    along = found.pose[:3, 3] - initial(OFF).pose[:3, 3]
    assert abs(along[0]) < 0.02
    assert abs(found.pose[1, 3] - STEP[1, 3]) < 0.02


def test_a_proposal_is_the_networks_own_answer_and_can_be_assessed_afterwards(weights, seen, monkeypatch):
    scans, wrong = [seen(np.eye(4), seed=0), seen(STEP, seed=1)], STEP @ se3.exp(3 * OFF)
    answers = []
    for proposing in (True, False):
        residual = source(weights(), scans, replace(FEW, refine_steps=0))
        answering(residual, wrong, monkeypatch)
        if proposing:
            assert np.allclose(residual.propose(frame(1), initial(OFF)), wrong, atol=1e-6)
        answers.append((residual.assess if proposing else residual.refine)(frame(1), initial(OFF)))
    assert not answers[0].ok
    assert np.array_equal(answers[0].covariance, answers[1].covariance)
    assert answers[0].details == answers[1].details


@pytest.mark.parametrize(("ahead_m", "looks"), [(0.1, 1), (0.3, 2)])
def test_after_a_long_correction_the_network_runs_again(weights, seen, monkeypatch, ahead_m, looks):
    residual, starts = source(weights(), [seen(np.eye(4), seed=0), seen(STEP, seed=1)]), []
    answer = type("Answer", (), {"pose": torch.tensor(STEP, dtype=torch.float32)[None]})
    monkeypatch.setattr(residual._network, "refine_encoded", lambda *given: (starts.append(given[2]), answer)[1])
    residual.propose(frame(1), initial(np.array([0, 0, 0, ahead_m, 0, 0])))
    assert len(starts) == looks
    assert np.allclose(starts[-1][0], STEP, atol=1e-6) == (looks == 2)


def test_imu_features_are_computed_once_a_scan_with_the_velocity_before_it(weights, seen, monkeypatch):
    scans = [seen(np.linalg.matrix_power(STEP, k), seed=k) for k in range(3)]
    residual = source(weights(imu="feature", velocity=True), scans, replace(FEW, refine_steps=0))
    features_seen, velocities = [], []
    answer = type("Answer", (), {"pose": torch.tensor(STEP, dtype=torch.float32)[None]})
    monkeypatch.setattr(residual._network, "refine_encoded", lambda *given: (features_seen.append(given[3]), answer)[1])
    features = residual._network.imu_network.features
    monkeypatch.setattr(
        residual._network.imu_network,
        "features",
        lambda imu, v: (velocities.append(v[0].tolist()), features(imu, v))[1],
    )
    far = initial(np.array([0, 0, 0, 0.3, 0, 0]))
    for k in (1, 2):
        residual.propose(frame(k), far)
        residual.assess(frame(k), far)
    assert len(features_seen) == 8  # two runs a step, because the correction is long
    assert len({id(features) for features in features_seen}) == len(velocities) == 2
    assert np.allclose(velocities, [np.zeros(3), STEP[:3, :3].T @ STEP[:3, 3] / 0.1], atol=1e-5)


def test_a_scan_with_too_few_cells_gets_no_proposal(weights, seen):
    residual = source(weights(), [seen(np.eye(4)), replace_points(seen(STEP, seed=1), 50)])
    assert residual.propose(frame(1), initial(OFF)) is None


def test_the_network_runs_on_one_thread_and_restores_the_number_of_threads(weights, seen, monkeypatch):
    torch.set_num_threads(2)
    residual, threads = source(weights(), [seen(np.eye(4), seed=0), seen(STEP, seed=1)]), []
    refine = residual._network.refine_encoded
    monkeypatch.setattr(
        residual._network, "refine_encoded", lambda *given: (threads.append(torch.get_num_threads()), refine(*given))[1]
    )
    residual.refine(frame(1), initial(OFF))
    assert (threads, torch.get_num_threads()) == ([1], 2)


def test_a_scan_with_too_few_cells_is_bridged_and_so_is_the_next_one(weights, seen):
    good, poor = seen(np.eye(4)), replace_points(seen(STEP, seed=1), 50)
    residual = source(weights(), [good, poor, good, good], replace(FEW, refine_steps=3))
    at_rest = RelativePose(se3.exp(OFF), WIDE, source="guess")
    oks = [residual.refine(frame(k), at_rest).ok for k in (1, 2, 3)]
    assert oks == [False, False, True]


def replace_points(scan, count):
    return type(scan)(scan.points[:count])


def test_a_first_scan_with_too_few_cells_is_an_error(weights, seen):
    with pytest.raises(DataError, match="frame 0"):
        source(weights(), [replace_points(seen(np.eye(4)), 20)])


def test_scans_prepared_for_other_cells_are_refused(weights, seen):
    scan = seen(np.eye(4))
    object.__setattr__(scan, "vertex_map", np.zeros((3, 5, 5), np.float32))
    with pytest.raises(ConfigError, match="cells"):
        source(weights(), [scan])


@pytest.mark.parametrize(
    "changes", [{"imu": "given"}, {"imu": "none"}, {"imu": "feature"}, {"normals": "none"}], ids=str
)
def test_every_variant_of_the_network_refines_a_given_initial_pose(weights, seen, changes):
    scans = [seen(np.eye(4), seed=0), seen(STEP, seed=1)]
    found = source(weights(**changes), scans, replace(FEW, refine_steps=8)).refine(frame(1), initial(OFF))
    assert found.ok
    assert not found.from_imu  # its covariance is from the points only, so a graph may use it with the IMU


def test_scans_several_steps_apart_are_registered_by_their_points_alone(weights, seen):
    scans = [seen(np.linalg.matrix_power(STEP, k), seed=k) for k in range(4)]
    residual = source(weights(imu="feature"), scans, replace(FEW, refine_steps=8))
    first = residual.current_scan
    for k in (1, 2, 3):
        residual.refine(frame(k), initial(OFF))
    far = np.linalg.matrix_power(STEP, 3)
    found = residual.pair(first, residual.current_scan, RelativePose(far @ se3.exp(OFF), WIDE, source="path"))
    assert found.ok
    assert (found.source, found.from_imu) == ("network", False)
    error = se3.log(se3.between(far, found.pose))
    assert np.abs(error[:3]).max() < 2e-3
    assert np.abs(error[3:]).max() < 0.02


def test_a_pair_with_too_few_cells_returns_the_initial_pose(weights, seen):
    residual = source(weights(), [seen(np.eye(4)), replace_points(seen(STEP, seed=1), 50)])
    first = residual.current_scan
    residual.refine(frame(1), initial(OFF))
    found = residual.pair(first, residual.current_scan, initial(OFF))
    assert not found.ok
    assert np.allclose(found.pose, initial(OFF).pose)


@pytest.mark.parametrize(
    "changes", [{"min_cells": 0}, {"min_matched": 1.5}, {"refine_steps": -1}, {"covariance_scale": 0}], ids=str
)
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(ConfigError):
        NetworkResidualSettings(**changes)
