"""Backends. Every registered implementation is tested against the same contract."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import bytes_of, check, guess, start_of, true_step

from hybridlio.core import se3
from hybridlio.core.estimates import Backend
from hybridlio.core.sensors import Frame, ImuSamples
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.registry import BACKENDS
from hybridlio.odometry.setup import Setup

BACKEND = sorted(BACKENDS)


@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
@pytest.mark.parametrize("name", BACKEND)
def test_a_backend_follows_true_steps(
    name: str, imu: bool, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    backend: Backend = BACKENDS[name](setup)
    assert backend.name == name
    given = first_frames if imu else [replace(frame, imu=ImuSamples.empty()) for frame in first_frames]
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
def test_a_backend_does_not_modify_its_input(name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]):
    backend, start, step = BACKENDS[name](setup), start_of(first_frames), true_step(sequence, 0, 1)
    before = [bytes_of(x) for x in (start, first_frames[1], step)]
    backend.start(start)
    backend.update(first_frames[1], step)
    backend.last_step()
    assert [bytes_of(x) for x in (start, first_frames[1], step)] == before


@pytest.mark.parametrize("name", BACKEND)
def test_a_backend_survives_failed_steps_and_missing_samples(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    backend = BACKENDS[name](setup)
    backend.start(start_of(first_frames))
    nothing = ImuSamples.empty()
    for k in range(1, len(first_frames)):
        step, frame = guess(sequence, k), first_frames[k]
        step = replace(step, ok=k % 2 == 0)
        frame = replace(frame, imu=nothing) if k in (3, 4) else frame
        state = backend.update(frame, step)
        assert np.isfinite(state.T_world_imu).all()
        np.linalg.cholesky(state.covariance)
        check(backend.last_step(), {name})
