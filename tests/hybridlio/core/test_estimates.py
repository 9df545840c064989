from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.covariance import check_covariance
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose

STEP = se3.exp(np.array([0.01, -0.02, 0.1, 1.0, 0.2, -0.1]))


@pytest.mark.parametrize(
    ("covariance", "what"),
    [
        (np.eye(5), r"finite \(6, 6\) covariance, got shape \(5, 5\)"),
        (np.diag([1.0, 1, 1, 1, 1, np.inf]), "finite"),
        (np.diag([1.0, 1, 1, 1, 1, 0]), "not positive definite"),
        (np.diag([1.0, 1, 1, 1, 1, -1e-9]), "not positive definite"),
        (np.eye(6) + np.triu(np.full((6, 6), 0.1), 1), "not symmetric"),
    ],
    ids=["shape", "infinite", "singular", "negative", "asymmetric"],
)
def test_an_invalid_covariance_is_refused_by_name(covariance: np.ndarray, what: str):
    with pytest.raises(DataError, match=f"wheel odometry: .*{what}"):
        check_covariance(covariance, "wheel odometry")


def test_asymmetry_from_rounding_is_averaged_out(rng: np.random.Generator):
    root = rng.normal(size=(6, 6)) * np.r_[np.full(3, 1e-4), np.full(3, 1e-2)][:, None]
    covariance = root @ root.T
    rounded = covariance * (1 + 1e-9 * rng.normal(size=(6, 6)))
    checked = check_covariance(rounded, "step")
    np.testing.assert_array_equal(checked, checked.T)
    np.testing.assert_allclose(checked, covariance, rtol=1e-8)


def test_small_variances_beside_large_ones_are_kept():
    covariance = np.diag([1e-9, 1e-9, 1e-9, 100.0, 1e-6, 1e-6])
    np.testing.assert_array_equal(check_covariance(covariance, "step"), covariance)


def test_a_relative_pose_is_checked_when_made_and_its_source_named():
    good = np.eye(6) * 1e-4
    with pytest.raises(DataError, match=r"my-source: relative pose.*not a rigid transform"):
        RelativePose(np.diag([2.0, 1.0, 1.0, 1.0]), good, "my-source")
    with pytest.raises(DataError, match=r"my-source: relative pose.*\(4, 4\)"):
        RelativePose(np.eye(3), good, "my-source")
    with pytest.raises(DataError, match=r"my-source: relative pose.*not positive definite"):
        RelativePose(STEP, -good, "my-source")


def test_rounded_rotations_are_orthonormalised():
    rounded = np.round(STEP, 5)
    rounded[3] = [0, 0, 0, 1]
    R = RelativePose(rounded, np.eye(6), "file").pose[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_a_relative_pose_is_immutable():
    step = RelativePose(STEP, np.eye(6), "test")
    with pytest.raises(FrozenInstanceError):
        step.ok = False  # type: ignore[misc]


def test_drift_must_not_exceed_the_covariance():
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
    step = RelativePose(STEP, covariance, "map", drift=0.02 * covariance)
    np.testing.assert_array_equal(step.drift, 0.02 * covariance)
    with pytest.raises(DataError, match="map: covariance less drift"):
        RelativePose(STEP, covariance, "map", drift=1.5 * covariance)
    with pytest.raises(DataError, match="map: drift"):
        RelativePose(STEP, covariance, "map", drift=0 * covariance)


def test_the_drift_of_a_failed_step_may_exceed_the_covariance_of_its_bridge():
    """A good IMU bridges a step more precisely than the map is known."""
    precise, path = np.eye(6) * 1e-12, np.eye(6) * 1e-6
    assert not RelativePose(STEP, precise, "imu", ok=False, drift=path).ok


def test_a_relative_pose_has_no_degenerate_directions_by_default():
    assert RelativePose(STEP, np.eye(6), "test").degenerate.shape == (0, 6)
