"""Users' own sources, backends and settings in the odometry."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from scans import blind

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Frame, ImuNoise
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config, parse_config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import run_odometry
from hybridlio.sources.constant_velocity import Identity


class Truth:
    """Predicts from the reference."""

    name = "truth"

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self.learnt: list[int] = []

    def predict(self, frame: Frame, state: State) -> RelativePose:  # noqa: ARG002
        assert self._sequence.reference is not None
        k = frame.index
        step = se3.between(self._sequence.reference.poses[k - 1], self._sequence.reference.poses[k])
        return RelativePose(step, np.eye(6) * 1e-6, self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:  # noqa: ARG002
        self.learnt.append(frame.index)


def test_a_users_initial_pose_source_is_used_and_corrected(frames: list[Frame], sequence: Sequence):
    source = Truth(sequence)
    odometry = Odometry(initial_pose=source)
    estimates = [odometry.step(frame) for frame in frames[:6]]
    assert source.learnt == [1, 2, 3, 4, 5]
    assert {e.initial.source for e in estimates if e.initial} == {"truth"}
    assert sequence.reference is not None
    assert np.linalg.norm(estimates[-1].pose[:3, 3] - sequence.reference.poses[5, :3, 3]) < 0.05


def test_a_bridged_step_does_not_correct_the_initial_pose_source(frames: list[Frame], sequence: Sequence):
    source = Truth(sequence)
    odometry = Odometry(initial_pose=source)
    for frame in frames[:6]:
        odometry.step(blind(frame) if frame.index in (3, 4) else frame)
    assert source.learnt == [1, 2, 5]


def test_a_users_backend_is_used(frames: list[Frame]):
    class Chained:
        name = "chained"

        def start(self, state: State) -> None:
            self.state = state

        def update(self, frame: Frame, relative: RelativePose) -> State:
            self.step = relative
            pose = self.state.T_world_imu @ relative.pose
            self.state = replace(self.state, stamp_ns=frame.scan.stamp_ns, T_world_imu=pose)
            return self.state

        def last_step(self) -> RelativePose:
            return self.step

    odometry = Odometry(initial_pose=Identity(), residual="none", backend=Chained())
    for frame in frames[:3]:
        estimate = odometry.step(frame)
    np.testing.assert_allclose(estimate.pose, np.eye(4), atol=1e-12)
    assert estimate.step is estimate.relative


def test_arguments_take_precedence_over_the_configuration(frames: list[Frame]):
    config = Config(initial_pose="identity", residual="none")
    both = [Odometry(config=config), Odometry(initial_pose="constant-velocity", config=config)]
    for odometry in both:
        odometry.step(frames[0])
    sources = [odometry.step(frames[1]).initial for odometry in both]
    assert [source.source for source in sources if source] == ["identity", "constant-velocity"]


def test_imu_noise_comes_from_configuration_then_recording_then_default(frames: list[Frame]):
    mine, recorded = ImuNoise(1e-2, 1e-1), ImuNoise(5e-4, 5e-3)

    def used(config: Config, in_frame: ImuNoise | None) -> ImuNoise:
        odometry = Odometry(residual="none", config=config)
        for frame in frames[:2]:
            odometry.step(replace(frame, imu_noise=in_frame))
        return odometry.record().imu_noise

    assert used(Config(imu_noise=mine), recorded) == mine
    assert used(Config(), recorded) == recorded
    assert used(Config(), None) == ImuNoise()


@pytest.mark.parametrize("choice", [{"initial_pose": "lstm"}, {"residual": "network"}])
def test_unreadable_weights_end_a_run_at_its_start(choice: dict, sequence: Sequence, caplog):
    lost = {"weights": "nowhere.safetensors"}
    run = run_odometry(sequence, Odometry(config=parse_config({"lstm": lost, "network": lost}, "here"), **choice))
    assert isinstance(run.stopped, ConfigError)
    assert "nowhere.safetensors: weights cannot be read" in str(run.stopped)
    warned = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert (run.done, run.unreadable, warned) == (0, {}, [])


def test_an_imu_without_noise_is_refused(frames: list[Frame]):
    for name in ("gyro_walk_rad_s2_sqrt_hz", "accel_bias_sigma_m_s2"):
        silent = replace(ImuNoise(), **{name: 0.0})
        with pytest.raises(ConfigError, match=f"ImuNoise.{name}: must be above 0, got 0"):
            Odometry(config=Config(imu_noise=silent)).step(frames[0])


def test_wrong_types_from_users_are_named(frames: list[Frame]):
    class Bare(Identity):
        name = "bare"

        def predict(self, frame: Frame, state: State) -> RelativePose:
            return super().predict(frame, state).pose  # type: ignore[return-value]

    odometry = Odometry(initial_pose=Bare())
    odometry.step(frames[0])
    with pytest.raises(ConfigError, match="source 'bare' must return a RelativePose, got ndarray"):
        odometry.step(frames[1])
    with pytest.raises(ConfigError, match=r"hybridlio\.load_config reads one"):
        Odometry(config="my.yaml")  # type: ignore[arg-type]
