import numpy as np
import pytest
from scipy.stats import chi2, norm

from estimators.numerics.quantiles import chi_square_quantile, normal_quantile


@pytest.mark.parametrize("probability", [0.001, 0.025, 0.5, 0.975, 0.999, 0.99999])
def test_quantiles_are_those_of_scipy_stats(probability):
    dof = np.array([1, 2, 3, 10, 100, 5000])
    # Both are inversions of the same function, good to a few units in the twelfth digit.
    np.testing.assert_allclose(chi_square_quantile(probability, dof), chi2.ppf(probability, dof), rtol=1e-11)
    np.testing.assert_allclose(normal_quantile(probability), norm.ppf(probability), rtol=1e-12, atol=1e-15)
