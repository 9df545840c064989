"""Residual sources. Every registered implementation is tested against the same contract."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import bytes_of, check, guess, true_step

from hybridlio.core import se3
from hybridlio.core.estimates import ResidualSource
from hybridlio.core.sensors import Frame, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.registry import RESIDUAL_SOURCES
from hybridlio.odometry.setup import Setup

RESIDUAL = sorted(RESIDUAL_SOURCES)


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_refines_along_a_drive(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    source: ResidualSource = RESIDUAL_SOURCES[name](setup)
    assert source.name == name
    source.start(first_frames[0])
    for k in range(1, len(first_frames)):
        initial, truth = guess(sequence, k), true_step(sequence, k - 1, k)
        refined = source.refine(first_frames[k], initial)
        check(refined, {name, "guess"})
        before, after = (se3.log(se3.between(x.pose, truth.pose)) for x in (initial, refined))
        assert np.linalg.norm(after[3:]) <= np.linalg.norm(before[3:]) + 1e-9
        if refined.source == name:
            assert np.linalg.norm(after[3:]) < 0.3 * np.linalg.norm(before[3:])


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_bridges_a_scan_without_points(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    source = RESIDUAL_SOURCES[name](setup)
    source.start(first_frames[0])
    source.refine(first_frames[1], guess(sequence, 1))
    nothing = replace(first_frames[2], scan=Scan(first_frames[2].scan.stamp_ns, np.empty((0, 3), np.float32)))
    initial = guess(sequence, 2)
    bridged = source.refine(nothing, initial)
    check(bridged, {name, "guess"})
    np.testing.assert_allclose(bridged.pose, initial.pose, atol=1e-12)
    check(source.refine(first_frames[3], guess(sequence, 3)), {name, "guess"})


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_does_not_modify_its_input(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    source, initial = RESIDUAL_SOURCES[name](setup), guess(sequence, 1)
    before = [bytes_of(x) for x in (first_frames[0], first_frames[1], initial)]
    source.start(first_frames[0])
    source.refine(first_frames[1], initial)
    assert [bytes_of(x) for x in (first_frames[0], first_frames[1], initial)] == before


@pytest.mark.parametrize("name", RESIDUAL)
def test_a_residual_source_can_be_restarted(name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]):
    source, answers = RESIDUAL_SOURCES[name](setup), []
    for _ in range(2):
        source.start(first_frames[0])
        answers.append(
            [bytes_of(replace(source.refine(first_frames[k], guess(sequence, k)), details={})) for k in (1, 2, 3)]
        )
    assert answers[0] == answers[1]
