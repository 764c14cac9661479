"""Roots of covariances, the singular ones too."""

import numpy as np
import pytest

from estimators.compiled.noise import add_noise, belief_root, semidefinite_root


def root(A):
    L = np.full_like(A, np.nan)
    return semidefinite_root(A, L), L


@pytest.mark.parametrize("n", [1, 2, 5, 12])
@pytest.mark.parametrize("lost", [0, 1, 3])
def test_a_root_of_any_rank(n, lost):
    rng = np.random.default_rng(n)
    B = rng.standard_normal((n, max(0, n - lost)))
    A = B @ B.T
    fine, L = root(A)
    assert fine
    assert np.array_equal(L, np.tril(L))
    # Directions whose pivot is below 1e-13 n of the diagonal are dropped: an error of its root at most.
    assert np.max(np.abs(L @ L.T - A), initial=0) <= 1e-6 * max(np.max(np.abs(A), initial=0), 1e-300)


def test_integrated_white_noise_and_zero():
    dt = 1e-3
    A = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    fine, L = root(A)
    assert fine and np.allclose(L @ L.T, A, rtol=1e-12)
    fine, L = root(np.zeros((3, 3)))
    assert fine and np.all(L == 0)


@pytest.mark.parametrize(
    "A",
    [
        [[1.0, 0.0], [0.0, -1e-3]],
        [[0.0, 1.0], [1.0, 0.0]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
        # The second has no variance but the first one's, of which the third knows nothing: eigenvalue -0.005.
        [[1.0, 1.0, 0.0], [1.0, 1.0, 0.1], [0.0, 0.1, 1.0]],
    ],
)
def test_what_is_no_covariance_is_refused_visibly(A):
    fine, L = root(np.array(A))
    assert not fine and np.all(np.isnan(L))


def test_variances_near_the_smallest_numbers_have_a_root():
    """A cloud that resampling made of near-copies of one particle: products of its variances are below all numbers."""
    v = np.array([8.1e-282, -1.5e-282, -1.5e-284])
    A = np.outer(v, v) / 1e-281
    fine, L = root(A)
    assert fine and np.allclose(L @ L.T, A, rtol=1e-6, atol=0.0)


def test_a_belief_that_rounding_made_indefinite_keeps_its_deviations():
    A = np.array([[4.0, 2.0 + 1e-3], [2.0 + 1e-3, 1.0]])
    L = np.full((2, 2), np.nan)
    belief_root(A, L)
    assert np.array_equal(L, np.diag([2.0, 1.0]))
    belief_root(np.eye(2) * 9.0, L)
    assert np.array_equal(L, 3.0 * np.eye(2))


def test_noise_is_added_through_the_whole_lower_triangle():
    L = np.array([[2.0, 9.0, 9.0], [3.0, 5.0, 9.0], [-1.0, 4.0, 7.0]])
    x = np.array([10.0, 20.0, 30.0])
    add_noise(L, np.array([1.0, 10.0, 100.0]), x)
    np.testing.assert_array_equal(x, [12.0, 73.0, 769.0])
