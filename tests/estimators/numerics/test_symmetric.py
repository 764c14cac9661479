"""Symmetric matrices against LAPACK, at orders from one up, of full and of low rank."""

import numpy as np
import pytest

from estimators.numerics.symmetric import factor, gram, solve_rows, symmetric_eigen

ORDERS = (1, 2, 3, 4, 7, 8, 9, 13, 24, 40, 65)


def psd(n, rank, seed=0):
    Z = np.random.default_rng([n, rank, seed]).standard_normal((rank, n))
    return Z.T @ Z


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("low_rank", [False, True])
def test_eigenvectors_rebuild_the_matrix(n, low_rank):
    """Backward stable: off by a small multiple of n ε of the largest eigenvalue."""
    A = psd(n, max(1, n // 3) if low_rank else 2 * n)
    work, values, V = A.copy(), np.empty(n), np.empty((n, n))
    assert symmetric_eigen(work, n, values, V, np.empty(3 * n))
    size = np.linalg.eigvalsh(A)[-1]
    np.testing.assert_allclose(V.T * values @ V, A, rtol=0, atol=1e-14 * n * size)
    np.testing.assert_allclose(V @ V.T, np.eye(n), rtol=0, atol=1e-14 * n)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(A), rtol=0, atol=1e-14 * n * size)


def test_numbers_that_are_not_finite_are_told():
    A = np.full((3, 3), np.nan)
    assert not symmetric_eigen(A.copy(), 3, np.empty(3), np.empty((3, 3)), np.empty(9))
    assert not factor(A, 3, np.empty((3, 3)))
    assert not factor(-2 * np.eye(3), 3, np.empty((3, 3)))
    # Behind the first panel of rows.
    assert not factor(np.diag([0.0] * 39 + [-2.0]), 40, np.empty((40, 40)))


@pytest.mark.parametrize("n", (*ORDERS, 70, 99))
def test_gram_factor_and_solve(n):
    rng = np.random.default_rng(n)
    Z, B = rng.standard_normal((5, n)), rng.standard_normal((n, 9))
    G, U = np.empty((n, n)), np.empty((n, n))
    gram(Z, 5, n, G)
    np.testing.assert_array_equal(G, G.T)
    np.testing.assert_allclose(G, Z.T @ Z, rtol=0, atol=1e-13 * n)
    assert factor(G, n, U)
    np.testing.assert_allclose(U.T @ U, np.eye(n) + G, rtol=0, atol=1e-13 * n)
    X = B.copy()
    solve_rows(U, n, X, 9)
    np.testing.assert_allclose((np.eye(n) + G) @ X, B, rtol=0, atol=1e-11)


@pytest.mark.parametrize("n", ORDERS)
def test_a_matrix_that_is_nearly_diagonal_keeps_what_stands_beside_the_diagonal(n):
    """Rows of zeros, and of numbers whose squares are none, are no reason to divide by nothing."""
    A = np.diag(np.arange(1.0, n + 1.0))
    if n > 2:
        A[0, n - 1] = A[n - 1, 0] = 1e-170
        A[n - 2, n - 1] = A[n - 1, n - 2] = 0.5
    values, V = np.empty(n), np.empty((n, n))
    assert symmetric_eigen(A.copy(), n, values, V, np.empty(3 * n))
    np.testing.assert_allclose(V.T * values @ V, A, rtol=0, atol=1e-14 * n * n)
