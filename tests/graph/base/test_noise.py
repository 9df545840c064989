import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.graph.base import noise
from hybridlio.graph.base.kernels import KERNELS
from hybridlio.graph.model.noise import Robust


def test_the_squared_whitened_residual_is_the_mahalanobis_distance(rng: np.random.Generator):
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T + np.eye(6)
    model = noise.gaussian(covariance, "step")
    residual = rng.normal(size=6)
    whitened = model.whiten(residual)
    assert whitened @ whitened == pytest.approx(residual @ np.linalg.solve(covariance, residual), rel=1e-9)


def test_sigmas_whiten_each_component_by_its_sigma():
    np.testing.assert_allclose(noise.sigmas(np.array([0.5, 2.0])).whiten(np.array([1.0, 1.0])), [2.0, 0.5])


@pytest.mark.parametrize(
    ("covariance", "what"),
    [
        (np.diag([1.0, -1.0, 1.0]), "not positive definite"),
        (np.diag([1.0, 0.0, 1.0]), "not positive definite"),
        (np.diag([1.0, np.nan, 1.0]), "finite"),
        (np.array([[1.0, 0.5, 0], [0, 1.0, 0], [0, 0, 1.0]]), "not symmetric"),
    ],
    ids=["negative", "singular", "not finite", "asymmetric"],
)
def test_an_invalid_covariance_is_an_error_with_the_measurements_name(covariance: np.ndarray, what: str):
    with pytest.raises(DataError, match=f"gps 7.*{what}"):
        noise.gaussian(covariance, "gps 7")


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("norm", [0.5, 2.5, 10.0])
def test_a_kernel_weighs_residuals_as_its_formula_does(kernel: str, norm: float):
    model = noise.with_kernel(noise.sigmas(np.ones(3)), kernel, 2.0)
    assert model.robust().weight(norm) == pytest.approx(Robust(kernel, 2.0).weight(norm), rel=1e-9)
