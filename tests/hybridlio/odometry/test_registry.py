"""Names of sources and backends."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import Calibration, ImuNoise
from hybridlio.odometry import names
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES, check_names
from hybridlio.odometry.setup import Setup

INITIAL, RESIDUAL, BACKEND = sorted(INITIAL_POSE_SOURCES), sorted(RESIDUAL_SOURCES), sorted(BACKENDS)


@pytest.mark.parametrize("kind", ["initial pose", "residual", "backend"])
def test_an_unknown_name_raises_an_error_that_lists_the_known_ones(kind: str):
    known = {"initial pose": INITIAL, "residual": RESIDUAL, "backend": BACKEND}
    names = {seam: "preintegrated" if seam == kind else choices[0] for seam, choices in known.items()}
    with pytest.raises(ConfigError, match=f"unknown {kind} 'preintegrated'") as error:
        check_names(names["initial pose"], names["residual"], names["backend"])
    assert all(name in str(error.value) for name in known[kind])


def test_objects_are_accepted_unchecked():
    check_names(object(), object(), object())


def test_a_setup_without_extrinsics_uses_the_identity():
    np.testing.assert_array_equal(Setup(Config(), Calibration(), ImuNoise()).calibration.T_imu_lidar, np.eye(4))


def test_the_configuration_knows_the_names_of_the_registry_and_no_others():
    known = (names.INITIAL_POSES, names.RESIDUALS, names.BACKENDS)
    assert known == (tuple(INITIAL_POSE_SOURCES), tuple(RESIDUAL_SOURCES), tuple(BACKENDS))
    for seam in ("initial_pose", "residual", "backend"):
        with pytest.raises(ConfigError, match=f"unknown {seam.replace('_', ' ')} 'isam2'; choose one of"):
            Config(**{seam: "isam2"})
