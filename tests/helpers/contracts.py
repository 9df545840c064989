"""Inputs and checks for contract tests of the seams' implementations along a simulated drive."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Frame, ImuNoise
from hybridlio.core.start_state import start_state
from hybridlio.datasets.sequence import Sequence


def true_step(sequence: Sequence, i: int, j: int) -> RelativePose:
    assert sequence.reference is not None
    pose = se3.between(sequence.reference.poses[i], sequence.reference.poses[j])
    return RelativePose(pose, np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2), "truth")


def start_of(frames: list[Frame]) -> State:
    return start_state(frames[0].scan.stamp_ns, frames[1].imu, ImuNoise())


def true_state(sequence: Sequence, k: int, start: State) -> State:
    """Return the true state at scan k, with a small covariance."""
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
    """Return every array and number in a tree of dataclasses as bytes, to detect changes."""
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


def guess(sequence: Sequence, k: int) -> RelativePose:
    """Return an initial pose 20 cm and a third of a degree off the true step."""
    pose = true_step(sequence, k - 1, k).pose @ se3.exp(np.array([0.003, -0.002, 0.005, 0.15, -0.1, 0.05]))
    return RelativePose(pose, np.diag(np.r_[np.full(3, 0.01), np.full(3, 0.2)] ** 2), "guess")
