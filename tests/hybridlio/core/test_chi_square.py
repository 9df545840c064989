import pytest

from hybridlio.core.chi_square import chi_square_quantile


@pytest.mark.parametrize(
    ("share", "freedom", "quantile"), [(0.5, 3, 2.366), (0.5, 6, 5.348), (0.99, 6, 16.812), (0.999, 6, 22.458)]
)
def test_quantiles_agree_with_published_tables(share: float, freedom: int, quantile: float):
    assert chi_square_quantile(share, freedom) == pytest.approx(quantile, abs=1e-3)
