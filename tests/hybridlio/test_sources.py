"""Every implementation of a seam is held to the same contract: a new one is tested by being listed."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio import se3
from hybridlio.config import Config
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.estimates import Backend, InitialPoseSource, RelativePose, ResidualSource, State
from hybridlio.learned.source_settings import LstmSettings, NetworkResidualSettings
from hybridlio.odometry import Odometry
from hybridlio.sensors import NS_PER_S, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.sources import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES, Setup
from hybridlio.startup import start_state

INITIAL, RESIDUAL, BACKEND = sorted(INITIAL_POSE_SOURCES), sorted(RESIDUAL_SOURCES), sorted(BACKENDS)


@pytest.fixture(scope="module")
def sequence(tiny_drive: Path) -> Sequence:
    return open_sequence(tiny_drive)


@pytest.fixture(scope="module")
def frames(sequence: Sequence) -> list[Frame]:
    return [sequence[k] for k in range(8)]


@pytest.fixture(scope="module")
def config(untrained_weights: Path) -> Config:
    """What the learned sources need for the drive's lidar: the shipped weights are for another one."""
    path = str(untrained_weights)
    return Config(lstm=LstmSettings(path, "cpu"), network=NetworkResidualSettings(path, "cpu", min_cells=200))


@pytest.fixture(scope="module")
def setup(sequence: Sequence, config: Config) -> Setup:
    return Setup(config, sequence.calibration, ImuNoise())


def true_step(sequence: Sequence, i: int, j: int) -> RelativePose:
    assert sequence.reference is not None
    pose = se3.between(sequence.reference.poses[i], sequence.reference.poses[j])
    return RelativePose(pose, np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2), "truth")


def start_of(frames: list[Frame]) -> State:
    return start_state(frames[0].scan.stamp_ns, frames[1].imu, ImuNoise())


def true_state(sequence: Sequence, k: int, start: State) -> State:
    """What a backend would know at scan k: nearly everything."""
    assert sequence.reference is not None
    T = sequence.calibration.T_imu_lidar
    poses = T @ sequence.reference.poses @ se3.inverse(T)
    stamps = sequence.stamps_ns
    velocity = (poses[k + 1, :3, 3] - poses[k - 1, :3, 3]) / ((stamps[k + 1] - stamps[k - 1]) / NS_PER_S)
    return replace(
        start,
        stamp_ns=int(stamps[k]),
        T_world_imu=poses[k],
        velocity_m_s=velocity,
        covariance=np.diag(np.r_[np.full(6, 1e-3), np.full(3, 0.1), np.full(3, 0.1), np.full(3, 0.01)] ** 2),
    )


def bytes_of(value: Any) -> list[bytes]:
    """Every array and number in a tree of dataclasses, to see whether one has changed."""
    if isinstance(value, np.ndarray):
        return [value.tobytes()]
    if is_dataclass(value):
        return [part for f in fields(value) for part in bytes_of(getattr(value, f.name))]
    return [repr(value).encode()]


def check(relative: RelativePose, names: set[str]) -> None:
    assert relative.source in names
    assert relative.pose.shape == (4, 4)
    assert np.isfinite(relative.pose).all()
    np.testing.assert_array_equal(relative.covariance, relative.covariance.T)
    assert np.linalg.eigvalsh(relative.covariance)[0] > 0
    assert relative.degenerate.shape[1:] == (6,)
    if relative.drift is not None and relative.ok:
        assert np.linalg.eigvalsh(relative.covariance - relative.drift)[0] > 0


# --------------------------------------------------------------------------------------- initial-pose sources


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_predicts_and_learns_along_a_drive(
    name: str, setup: Setup, sequence: Sequence, frames: list[Frame]
):
    source: InitialPoseSource = INITIAL_POSE_SOURCES[name](setup)
    assert source.name == name
    state, off = start_of(frames), []
    for k in range(1, len(frames)):
        predicted = source.predict(frames[k], state)
        check(predicted, {name})
        truth = true_step(sequence, k - 1, k)
        error = se3.log(se3.between(predicted.pose, truth.pose))
        off.append(np.sqrt(error @ np.linalg.solve(predicted.covariance, error)))
        source.correct(frames[k], truth)
        state = true_state(sequence, k, state)
    assert max(off) < 5  # six dimensions: 4.6 is passed once in a thousand times


@pytest.mark.parametrize("name", INITIAL)
def test_at_the_start_an_initial_pose_source_admits_that_it_knows_no_speed(
    name: str, setup: Setup, frames: list[Frame]
):
    predicted = INITIAL_POSE_SOURCES[name](setup).predict(frames[1], start_of(frames))
    assert np.linalg.norm(predicted.pose[:3, 3]) < 0.5
    assert 3 * np.sqrt(predicted.covariance[3, 3]) > 3.0  # 30 m/s for a tenth of a second


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_keeps_up_when_scans_are_missing(
    name: str, setup: Setup, sequence: Sequence, frames: list[Frame]
):
    source, state, at = INITIAL_POSE_SOURCES[name](setup), start_of(frames), 0
    spreads = {}
    for k in (1, 2, 3, 6, 7):
        imu = sequence.imu.between(state.stamp_ns, frames[k].scan.stamp_ns)
        frame = replace(frames[k], imu=imu)
        predicted = source.predict(frame, state)
        check(predicted, {name})
        truth = true_step(sequence, at, k)
        if k > 3:
            spreads[k - at] = np.sqrt(np.trace(predicted.covariance[3:, 3:]))
            if name != "identity":
                assert np.linalg.norm(se3.between(predicted.pose, truth.pose)[:3, 3]) < 0.3
        source.correct(frame, truth)
        state, at = true_state(sequence, k, state), k
    assert spreads[3] > spreads[1]


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_leaves_its_input_as_it_was(name: str, setup: Setup, frames: list[Frame]):
    source, state = INITIAL_POSE_SOURCES[name](setup), start_of(frames)
    step = RelativePose(np.eye(4), np.eye(6) * 1e-4, "test")
    before = [bytes_of(x) for x in (frames[1], state, step)]
    source.predict(frames[1], state)
    source.correct(frames[1], step)
    assert [bytes_of(x) for x in (frames[1], state, step)] == before


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_repeats_itself(name: str, setup: Setup, sequence: Sequence, frames: list[Frame]):
    def drive() -> list[bytes]:
        source, state, out = INITIAL_POSE_SOURCES[name](setup), start_of(frames), []
        for k in range(1, 5):
            out += bytes_of(source.predict(frames[k], state))
            source.correct(frames[k], true_step(sequence, k - 1, k))
            state = true_state(sequence, k, state)
        return out

    assert drive() == drive()


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_sources_answer_knows_whether_the_imu_was_in_it(name: str, setup: Setup, frames: list[Frame]):
    """What came from the samples must not be counted beside them: without samples nothing is from them."""
    frame = replace(frames[1], imu=ImuSamples.empty())
    assert not INITIAL_POSE_SOURCES[name](setup).predict(frame, start_of(frames)).from_imu


# ------------------------------------------------------------------------------------------- residual sources


def guess(sequence: Sequence, k: int) -> RelativePose:
    """The true step, 20 cm and a third of a degree off."""
    pose = true_step(sequence, k - 1, k).pose @ se3.exp(np.array([0.003, -0.002, 0.005, 0.15, -0.1, 0.05]))
    return RelativePose(pose, np.diag(np.r_[np.full(3, 0.01), np.full(3, 0.2)] ** 2), "guess")


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_refines_along_a_drive(name: str, setup: Setup, sequence: Sequence, frames: list[Frame]):
    source: ResidualSource = RESIDUAL_SOURCES[name](setup)
    assert source.name == name
    source.start(frames[0])
    for k in range(1, len(frames)):
        initial, truth = guess(sequence, k), true_step(sequence, k - 1, k)
        refined = source.refine(frames[k], initial)
        check(refined, {name, "guess"})
        before, after = (se3.log(se3.between(x.pose, truth.pose)) for x in (initial, refined))
        assert np.linalg.norm(after[3:]) <= np.linalg.norm(before[3:]) + 1e-9
        if refined.source == name:
            assert np.linalg.norm(after[3:]) < 0.3 * np.linalg.norm(before[3:])


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_goes_on_over_a_scan_without_points(
    name: str, setup: Setup, sequence: Sequence, frames: list[Frame]
):
    source = RESIDUAL_SOURCES[name](setup)
    source.start(frames[0])
    source.refine(frames[1], guess(sequence, 1))
    nothing = replace(frames[2], scan=Scan(frames[2].scan.stamp_ns, np.empty((0, 3), np.float32)))
    initial = guess(sequence, 2)
    bridged = source.refine(nothing, initial)
    check(bridged, {name, "guess"})
    np.testing.assert_allclose(bridged.pose, initial.pose, atol=1e-12)
    check(source.refine(frames[3], guess(sequence, 3)), {name, "guess"})


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_leaves_its_input_as_it_was(name: str, setup: Setup, sequence: Sequence, frames: list[Frame]):
    source, initial = RESIDUAL_SOURCES[name](setup), guess(sequence, 1)
    before = [bytes_of(x) for x in (frames[0], frames[1], initial)]
    source.start(frames[0])
    source.refine(frames[1], initial)
    assert [bytes_of(x) for x in (frames[0], frames[1], initial)] == before


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_starts_again_as_if_new(name: str, setup: Setup, sequence: Sequence, frames: list[Frame]):
    source, answers = RESIDUAL_SOURCES[name](setup), []
    for _ in range(2):
        source.start(frames[0])
        answers.append([bytes_of(replace(source.refine(frames[k], guess(sequence, k)), details={})) for k in (1, 2, 3)])
    assert answers[0] == answers[1]


# ---------------------------------------------------------------------------------------------------- backends


@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
@pytest.mark.parametrize("name", BACKEND)
def test_a_backend_follows_true_steps(name: str, imu: bool, setup: Setup, sequence: Sequence, frames: list[Frame]):
    backend: Backend = BACKENDS[name](setup)
    assert backend.name == name
    given = frames if imu else [replace(frame, imu=ImuSamples.empty()) for frame in frames]
    backend.start(start_of(given))
    assert sequence.reference is not None
    T = sequence.calibration.T_imu_lidar
    for k in range(1, len(given)):
        truth = true_step(sequence, k - 1, k)
        state = backend.update(given[k], truth)
        assert state.stamp_ns == given[k].scan.stamp_ns
        assert state.has_imu == imu
        assert np.linalg.eigvalsh(state.covariance[:6, :6])[0] > 0
        lidar = se3.inverse(T) @ state.T_world_imu @ T
        assert np.linalg.norm(lidar[:3, 3] - sequence.reference.poses[k, :3, 3]) < 0.05
        step = backend.last_step()
        check(step, {name})
        assert np.linalg.norm(se3.log(se3.between(step.pose, truth.pose))) < 0.05


@pytest.mark.parametrize("name", BACKEND)
def test_a_backend_leaves_its_input_as_it_was(name: str, setup: Setup, sequence: Sequence, frames: list[Frame]):
    backend, start, step = BACKENDS[name](setup), start_of(frames), true_step(sequence, 0, 1)
    before = [bytes_of(x) for x in (start, frames[1], step)]
    backend.start(start)
    backend.update(frames[1], step)
    backend.last_step()
    assert [bytes_of(x) for x in (start, frames[1], step)] == before


@pytest.mark.parametrize("name", BACKEND)
def test_a_backend_survives_failed_steps_and_missing_samples(
    name: str, setup: Setup, sequence: Sequence, frames: list[Frame]
):
    backend = BACKENDS[name](setup)
    backend.start(start_of(frames))
    nothing = ImuSamples.empty()
    for k in range(1, len(frames)):
        step, frame = guess(sequence, k), frames[k]
        step = replace(step, ok=k % 2 == 0)
        frame = replace(frame, imu=nothing) if k in (3, 4) else frame
        state = backend.update(frame, step)
        assert np.isfinite(state.T_world_imu).all()
        np.linalg.cholesky(state.covariance)
        check(backend.last_step(), {name})


# ----------------------------------------------------------------------------------------------- all of them


@pytest.mark.parametrize("residual", RESIDUAL)
@pytest.mark.parametrize("initial", INITIAL)
def test_any_initial_pose_goes_with_any_residual(initial: str, residual: str, frames: list[Frame], config: Config):
    odometry = Odometry(initial, residual, config=config)
    for frame in frames[:4]:
        estimate = odometry.step(frame)
        assert np.isfinite(estimate.pose).all()
        np.linalg.cholesky(estimate.covariance)
    assert estimate.index == 3


@pytest.mark.parametrize(
    "table", [INITIAL_POSE_SOURCES, RESIDUAL_SOURCES, BACKENDS], ids=["initial", "residual", "backend"]
)
def test_each_entry_makes_a_new_object_each_time(table: dict[str, Callable[[Setup], Any]], setup: Setup):
    for name, make in table.items():
        first, second = make(setup), make(deepcopy(setup))
        assert first is not second
        assert first.name == second.name == name
