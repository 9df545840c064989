"""Combinations of implementations of the three seams."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from hybridlio.core.sensors import Frame
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES
from hybridlio.odometry.setup import Setup


@pytest.mark.parametrize("residual", sorted(RESIDUAL_SOURCES))
@pytest.mark.parametrize("initial", sorted(INITIAL_POSE_SOURCES))
def test_every_initial_pose_source_works_with_every_residual_source(
    initial: str, residual: str, first_frames: list[Frame], learned_config: Config
):
    odometry = Odometry(initial, residual, config=learned_config)
    for frame in first_frames[:4]:
        estimate = odometry.step(frame)
        assert np.isfinite(estimate.pose).all()
        np.linalg.cholesky(estimate.covariance)
    assert estimate.index == 3


@pytest.mark.parametrize(
    "table", [INITIAL_POSE_SOURCES, RESIDUAL_SOURCES, BACKENDS], ids=["initial", "residual", "backend"]
)
def test_each_entry_makes_a_new_object(table: dict[str, Callable[[Setup], Any]], setup: Setup):
    for name, make in table.items():
        first, second = make(setup), make(deepcopy(setup))
        assert first is not second
        assert first.name == second.name == name
