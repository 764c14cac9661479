"""Small matrices in vectors against NumPy, at orders on both sides of a vector's length, rubbish behind the rows."""

import numpy as np
import pytest
from numba import njit

from estimators.numerics.simd_ir import padded
from estimators.numerics.simd_rows import (
    covariance,
    cross_covariance,
    factor,
    multiply_rows,
    spread_points,
    subtract_product,
    subtract_squares,
)

ORDERS = (1, 2, 3, 4, 5, 7, 8, 9, 13, 16, 24)


def rows(count, n, rng):
    """Rows of n numbers and, up to whole vectors, of rubbish."""
    whole = np.full((count, padded(n)), 1e77)
    whole[:, :n] = rng.standard_normal((count, n))
    return whole


@njit
def factored(P, U):
    return factor(P, U)


@njit
def points_of(x, U, spread, points):
    spread_points(x, U, spread, points)


@njit
def covariance_of(D, first, w, P):
    covariance(D, first, w, P)


@njit
def cross_covariance_of(U, across, w, C):
    cross_covariance(U, across, w, C)


@njit
def without_squares(n, m, W, P):
    subtract_squares(W, m, P.shape[0], P)


@njit
def products(base, A, rows, B, out, difference):
    multiply_rows(A, rows, B.shape[0], B, 0, out)
    subtract_product(base, A, rows, B.shape[0], B, base.shape[0], difference)


@pytest.mark.parametrize("n", ORDERS)
def test_factor_is_choleskys_and_nothing_stands_below_its_diagonal(n):
    rng = np.random.default_rng(n)
    Z = rng.standard_normal((2 * n, n))
    P, U = Z.T @ Z, np.full((n, padded(n)), 1e77)
    assert factored(P, U)
    np.testing.assert_allclose(U[:, :n], np.linalg.cholesky(P).T, rtol=0, atol=1e-14 * n * np.sqrt(np.max(P)))
    assert not np.any(np.tril(U[:, :n], -1))


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_factor_refuses_what_has_none_wherever_it_shows(n, bad):
    for k in range(n):
        P = np.eye(n)
        P[k, k] = bad
        assert not factored(P, np.empty((n, padded(n))))


@pytest.mark.parametrize("n", ORDERS)
def test_points_stand_around_the_mean(n):
    rng = np.random.default_rng(n)
    x, U = rng.standard_normal(n), rows(n, n, rng)
    points = np.empty((2 * n + 1, padded(n)))
    points_of(x, U, 0.7, points)
    own = 0.7 * U[:, :n]
    np.testing.assert_allclose(points[:, :n], np.vstack((x, x + own, x - own)), rtol=1e-15)


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("m", [1, 3, 8, 11])
def test_covariances_are_the_weighted_sums_and_symmetric_to_the_last_bit(n, m):
    rng = np.random.default_rng([n, m])
    D, P = rows(2 * n + 1, m, rng), np.full((m, m), np.nan)
    covariance_of(D, -3.3, 0.4, P)
    own = D[:, :m]
    expected = -3.3 * np.outer(own[0], own[0]) + 0.4 * own[1:].T @ own[1:]
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-15 * 20 * (2 * n + 1))
    np.testing.assert_array_equal(P, P.T)
    U, across, C = rows(n, n, rng), rows(n, m, rng), np.full((n, m), np.nan)
    cross_covariance_of(U, across, 0.4, C)
    np.testing.assert_allclose(C, 0.4 * U[:, :n].T @ across[:, :m], rtol=0, atol=1e-15 * 20 * n)


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("m", [1, 2, 5])
def test_squares_are_subtracted_and_what_is_symmetric_stays_so(n, m):
    rng = np.random.default_rng([n, m])
    W, Z = rows(m, n, rng), rng.standard_normal((n, n))
    room = np.full(n * n + 8, 5.0)
    P = room[: n * n].reshape(n, n)
    P[:] = Z.T @ Z
    expected = P - W[:, :n].T @ W[:, :n]
    without_squares(n, m, W, P)
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-15 * 20 * (n + m))
    np.testing.assert_array_equal(P, P.T)
    assert np.all(room[n * n :] == 5.0), "it wrote behind the matrix"


@pytest.mark.parametrize("n", [8, 9, 15, 16, 17, 24, 33])
@pytest.mark.parametrize("m", [1, 3, 4, 6, 9])
def test_products_in_blocks(n, m):
    """The leading rows alone are written, and of a difference the lower triangle if that is asked for."""
    rng = np.random.default_rng(n)
    A, B, base = rng.standard_normal((m + 1, m + 2)), rng.standard_normal((m, n)), rng.standard_normal((m, n))
    A[rng.random(A.shape) < 0.5] = 0.0
    out, difference = np.full((m + 1, padded(n)), 1e77), np.full((m + 1, n), 1e77)
    products(base, A, m, B, out, difference)
    expected = A[:m, :m] @ B
    np.testing.assert_allclose(out[:m, :n], expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(out[m], 1e77)
    np.testing.assert_array_equal(out[:, n:], 1e77)
    np.testing.assert_allclose(np.tril(difference[:m]), np.tril(base - expected), rtol=0, atol=1e-13)
    np.testing.assert_array_equal(difference[m], 1e77)
