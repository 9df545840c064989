"""Sources and backends are found by name."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import Calibration, ImuNoise
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES, check_names
from hybridlio.odometry.setup import Setup

INITIAL, RESIDUAL, BACKEND = sorted(INITIAL_POSE_SOURCES), sorted(RESIDUAL_SOURCES), sorted(BACKENDS)


@pytest.mark.parametrize("kind", ["initial pose", "residual", "backend"])
def test_an_unknown_name_is_an_error_that_lists_those_there_are(kind: str):
    known = {"initial pose": INITIAL, "residual": RESIDUAL, "backend": BACKEND}
    names = {seam: "preintegrated" if seam == kind else choices[0] for seam, choices in known.items()}
    with pytest.raises(ConfigError, match=f"unknown {kind} 'preintegrated'") as error:
        check_names(names["initial pose"], names["residual"], names["backend"])
    assert all(name in str(error.value) for name in known[kind])


def test_objects_are_taken_as_they_are():
    check_names(object(), object(), object())


def test_a_setup_without_extrinsics_has_the_identity():
    np.testing.assert_array_equal(Setup(Config(), Calibration(), ImuNoise()).calibration.T_imu_lidar, np.eye(4))
