"""Symmetric matrices against LAPACK, at orders from one up, of full and of low rank."""

import numpy as np
import pytest

from estimators.symmetric import factor, gram, root_action, solve_rows, symmetric_eigen

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


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("low_rank", [False, True])
@pytest.mark.parametrize("inverse_root", [False, True])
def test_the_action_of_a_function_needs_no_eigenvectors(n, low_rank, inverse_root):
    A = psd(n, max(1, n // 3) if low_rank else 2 * n)
    rng = np.random.default_rng(n)
    b, g = rng.standard_normal((2, n))
    values, vectors = np.linalg.eigh(A)
    grown = 1 + np.maximum(values, 0)
    f = 1 / np.sqrt(grown) if inverse_root else 1 / (grown + np.sqrt(grown))
    expected, product = vectors * f @ vectors.T @ b, b @ np.linalg.solve(np.eye(n) + A, g)
    x = b.copy()
    scratch = np.empty(3 * n + 3 * (2 * n * n + 8 * n))
    found = root_action(A.copy(), n, np.empty(n), x, g.copy(), inverse_root, scratch)
    scale = np.linalg.norm(b) * np.linalg.norm(g)
    assert found == pytest.approx(product, rel=0, abs=1e-13 * n * scale)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-13 * n * np.linalg.norm(b))


def test_numbers_that_are_not_finite_are_told():
    A = np.full((3, 3), np.nan)
    assert not symmetric_eigen(A.copy(), 3, np.empty(3), np.empty((3, 3)), np.empty(9))
    scratch = np.empty(9 + 3 * (18 + 24))
    assert np.isnan(root_action(A.copy(), 3, np.empty(3), np.ones(3), np.ones(3), True, scratch))
    assert not factor(A, 3, np.empty((3, 3)))
    assert not factor(-2 * np.eye(3), 3, np.empty((3, 3)))


@pytest.mark.parametrize("n", ORDERS)
def test_gram_factor_and_solve(n):
    rng = np.random.default_rng(n)
    Z, B = rng.standard_normal((5, n)), rng.standard_normal((n, 9))
    G, U = np.empty((n, n)), np.empty((n, n))
    gram(Z, 5, n, G)
    np.testing.assert_allclose(G, Z.T @ Z, rtol=0, atol=1e-13 * n)
    assert factor(G, n, U)
    np.testing.assert_allclose(U.T @ U, np.eye(n) + G, rtol=0, atol=1e-13 * n)
    X = B.copy()
    solve_rows(U, n, X, 9)
    np.testing.assert_allclose((np.eye(n) + G) @ X, B, rtol=0, atol=1e-11)
