"""Normal scores and quantiles against SciPy's distributions."""

import numpy as np
import pytest
from numba import njit
from scipy.special import ndtr, ndtri
from scipy.stats import chi2, norm, t

from estimators.numerics import normal_score as scores
from estimators.numerics.quantiles import chi_square_quantile, normal_quantile


@njit(error_model="numpy")
def tails_of(d, shift, scale, w, tails):
    scores.add_tails(d.size, d, shift, scale, w, tails)


@njit(error_model="numpy")
def tails_one_by_one(z, w, tails):
    for i in range(z.size):
        scores.add_tail(z[i], w[i], tails)


@pytest.mark.parametrize("n", [1, 3, 7, 8, 9, 64, 1000])
def test_tails_of_a_mixture(n):
    """Within 2e-8 of each term, so of the sum of positive terms; the exact ones within the rounding of erfc and sum."""
    rng = np.random.default_rng(n)
    d, w, shift, scale = rng.normal(0, 3, n), rng.random(n), 0.3, 2.0
    z = scale * (d + shift)
    expected = np.array([w @ ndtr(z), w @ ndtr(-z)])
    fast, exact = np.array([1.0, 2.0]), np.array([1.0, 2.0])
    tails_of(d, shift, scale, w, fast)
    tails_one_by_one(z, w, exact)
    np.testing.assert_allclose(fast - [1.0, 2.0], expected, rtol=2e-8, atol=1e-13)
    np.testing.assert_allclose(exact - [1.0, 2.0], expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("z", [-37.0, -20.0, -5.0, -1e-9, 0.0, 0.1, 3.0, 8.0, 36.0])
def test_tails_far_out_keep_their_digits(z):
    """Relative to the tail itself: 1e-300 is as good as 0.5."""
    tails = np.zeros(2)
    tails_of(np.array([z]), 0.0, 1.0, np.array([1.0]), tails)
    np.testing.assert_allclose(tails, [ndtr(z), ndtr(-z)], rtol=2e-8)


def test_tails_at_the_ends():
    for z, expected in ((np.inf, [1.0, 0.0]), (-np.inf, [0.0, 1.0]), (1e300, [1.0, 0.0]), (np.nan, [np.nan] * 2)):
        tails = np.zeros(2)
        tails_of(np.array([z]), 0.0, 1.0, np.array([1.0]), tails)
        np.testing.assert_array_equal(tails, expected)


def test_the_quantile_is_the_normal_one():
    """AS 241 gives 16 digits; between them and SciPy's are a few roundings."""
    p = 10.0 ** np.random.default_rng(0).uniform(-300, np.log10(0.5), 5000)
    found = np.array([scores.tail_quantile(value) for value in p])
    np.testing.assert_allclose(found, -ndtri(p), rtol=1e-14, atol=1e-15)


def test_a_score_is_odd_bounded_and_never_falls():
    z = np.linspace(-12.0, 12.0, 4001)
    e = np.array([scores.normal_score(3.0 * ndtr(value), 3.0 * ndtr(-value)) for value in z])
    np.testing.assert_allclose(e, np.clip(z, -scores.FURTHEST, scores.FURTHEST), atol=1e-11)
    assert np.all(np.diff(e) >= 0)
    assert scores.normal_score(0.0, 1.0) == -scores.FURTHEST and scores.normal_score(1.0, 0.0) == scores.FURTHEST
    assert np.isnan(scores.normal_score(0.0, 0.0)) and np.isnan(scores.normal_score(np.nan, 1.0))


@pytest.mark.parametrize(
    ("dof", "within", "far"), [(1.0, 0.2, 0.2), (9.0, 0.006, 0.05), (19.5, 0.0012, 0.012), (49.0, 0.0002, 0.002)]
)
def test_students_score(dof, within, far):
    """The errors that the docstring names, of Wallace's closed form, over |e| ≤ 3 and |e| ≤ 6."""
    x = np.linspace(-40.0, 40.0, 3001)
    exact = np.sign(x) * norm.isf(t.sf(np.abs(x), dof))
    found = np.array([scores.student_score(value, dof) for value in x])
    assert np.max(np.abs(found - exact)[np.abs(exact) < 3]) < within
    assert np.max(np.abs(found - exact)[np.abs(exact) < 6]) < far
    assert np.all(np.diff(found) >= 0)


def test_students_score_of_many_degrees_is_the_number_itself():
    for x in (-3.0, 0.0, 2.5):
        assert abs(scores.student_score(x, 1e7) - x) < 1e-6
        assert scores.student_score(x, np.inf) == x
    assert scores.student_score(1e9, np.inf) == scores.FURTHEST
    assert np.isnan(scores.student_score(np.nan, 9.0))


@pytest.mark.parametrize("probability", [0.001, 0.025, 0.5, 0.975, 0.999, 0.99999])
def test_quantiles_are_those_of_scipy_stats(probability):
    dof = np.array([1, 2, 3, 10, 100, 5000])
    # Both are inversions of the same function, good to a few units in the twelfth digit.
    np.testing.assert_allclose(chi_square_quantile(probability, dof), chi2.ppf(probability, dof), rtol=1e-11)
    np.testing.assert_allclose(normal_quantile(probability), norm.ppf(probability), rtol=1e-12, atol=1e-15)
