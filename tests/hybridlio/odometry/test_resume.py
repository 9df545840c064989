"""A resumed odometry continues as the one whose state it has, to the last bit, whatever the sources."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from resumed import check_resumed_at, without_points

from hybridlio.core.sensors import Frame, ImuSamples, Scan
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES
from hybridlio.sources.settings import ScanMatchingSettings

CHOICES = (
    [{"initial_pose": name} for name in INITIAL_POSE_SOURCES]
    + [{"residual": name} for name in RESIDUAL_SOURCES]
    + [{"backend": name} for name in BACKENDS]
)


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: "-".join(choice.values()))
def test_a_resumed_odometry_continues_to_the_last_bit(
    choice: dict[str, str], frames: list[Frame], learned_config: Config
) -> None:
    check_resumed_at(8, frames[:13], learned_config.model_copy(update=choice))


@pytest.mark.parametrize("cut", [2, 21])
def test_it_may_be_resumed_early_and_late(cut: int, frames: list[Frame]) -> None:
    check_resumed_at(cut, frames, Config())


def test_matching_the_last_scan_and_recent_ones_is_resumed_too(frames: list[Frame]) -> None:
    check_resumed_at(8, frames[:13], Config(scan_matching=ScanMatchingSettings(target="last-scan")))


def test_a_run_with_rejected_and_missing_scans_is_resumed_too(frames: list[Frame]) -> None:
    damaged = frames[:20]
    damaged[13] = replace(damaged[13], scan=Scan(damaged[13].scan.stamp_ns, np.empty((0, 3), np.float32)))
    damaged[14] = replace(damaged[14], scan=replace(frames[3].scan, stamp_ns=damaged[14].scan.stamp_ns))
    check_resumed_at(15, damaged, Config())


def test_a_run_whose_imu_starts_late_is_resumed_too(frames: list[Frame]) -> None:
    late = [replace(frame, imu=ImuSamples.empty()) if frame.index < 5 else frame for frame in frames[:14]]
    check_resumed_at(10, late, Config())


def test_there_is_no_state_before_the_second_estimate(frames: list[Frame]) -> None:
    odometry = Odometry()
    assert odometry.state() is None
    odometry.step(frames[0])
    assert odometry.state() is None


def test_other_inertial_samples_show_as_a_difference(frames: list[Frame]) -> None:
    odometry = Odometry()
    estimates = [odometry.step(frame) for frame in frames[:8]]
    other = [replace(f, imu=replace(f.imu, accel_m_s2=f.imu.accel_m_s2 + 0.5)) for f in frames[:8]]
    state = odometry.state()
    assert state is not None
    assert Odometry().resume(without_points(other, estimates), state) > 1e-5
