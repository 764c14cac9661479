"""Our dense linear algebra against NumPy's."""

import numpy as np
import pytest
from numba import njit

from estimators.numerics.linalg import (
    cholesky,
    congruence,
    mirror,
    remove,
    root,
    solve_transposed,
    solve_unit,
    solve_upper,
    triangularise,
    unit_factor,
    wrap,
)

SIZES = (1, 2, 3, 5, 8, 16, 33)
# LAPACK's bound for these algorithms is n ε cond(A), relative; the matrices below have a condition of 1e2 to 1e4.
TOLERANCE = 1e-10


@njit
def congruence_of(F, rows, P, T):
    congruence(F, rows, P, T)


def spd(rng, n):
    root = rng.normal(0, 1, (n, n))
    return root @ root.T + 0.1 * n * np.eye(n)


@pytest.mark.parametrize("n", SIZES)
def test_cholesky(n):
    A = spd(np.random.default_rng(n), n)
    U = np.full((n, n), np.nan)
    assert cholesky(A, U, n)
    np.testing.assert_allclose(U, np.linalg.cholesky(A).T, rtol=0, atol=TOLERANCE * np.abs(A).max())
    assert np.all(U[np.tril_indices(n, -1)] == 0)


def test_cholesky_reads_the_upper_triangle_only_and_works_in_place():
    A = spd(np.random.default_rng(1), 6)
    expected = np.linalg.cholesky(A).T
    A[np.tril_indices(6, -1)] = np.nan
    assert cholesky(A, A, 6)
    np.testing.assert_allclose(A, expected, rtol=0, atol=TOLERANCE * np.abs(expected).max())


def test_cholesky_of_leading_rows_leaves_the_rest():
    A = spd(np.random.default_rng(2), 6)
    U = np.full((6, 6), 7.0)
    assert cholesky(A, U, 4)
    np.testing.assert_allclose(U[:4, :4], np.linalg.cholesky(A[:4, :4]).T, rtol=0, atol=TOLERANCE * np.abs(A).max())
    assert np.all(U[4:] == 7.0)
    assert np.all(U[:, 4:] == 7.0)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_cholesky_refuses_what_has_no_factor(n, value):
    rng = np.random.default_rng(n)
    A = spd(rng, n)
    spoilt = int(rng.integers(n))
    A[spoilt, spoilt] = value
    assert not cholesky(A, np.empty((n, n)), n)


def test_cholesky_refuses_an_indefinite_matrix_with_a_positive_diagonal():
    assert not cholesky(np.array([[1.0, 2.0], [2.0, 1.0]]), np.empty((2, 2)), 2)
    assert not cholesky(np.ones((2, 2)), np.empty((2, 2)), 2)


@pytest.mark.parametrize("n", SIZES)
def test_solves(n):
    rng = np.random.default_rng(n)
    A = spd(rng, n)
    U = np.linalg.cholesky(A).T.copy()
    b = rng.normal(0, 1, n)
    for solve, matrix in ((solve_transposed, U.T), (solve_upper, U)):
        x = b.copy()
        solve(U, n, x)
        np.testing.assert_allclose(x, np.linalg.solve(matrix, b), rtol=TOLERANCE, atol=TOLERANCE)
    x = b.copy()
    solve_transposed(U, n, x)
    solve_upper(U, n, x)
    np.testing.assert_allclose(A @ x, b, rtol=0, atol=TOLERANCE)


def test_solves_with_leading_rows_leave_the_rest():
    rng = np.random.default_rng(3)
    U = np.linalg.cholesky(spd(rng, 5)).T.copy()
    for solve, matrix in ((solve_transposed, U[:3, :3].T), (solve_upper, U[:3, :3])):
        b = rng.normal(0, 1, 5)
        x = b.copy()
        solve(U, 3, x)
        np.testing.assert_allclose(x[:3], np.linalg.solve(matrix, b[:3]), rtol=TOLERANCE)
        np.testing.assert_array_equal(x[3:], b[3:])


@pytest.mark.parametrize("share", [1.0, 0.4])
@pytest.mark.parametrize(("n", "rows"), [*((n, n) for n in SIZES), (2, 1), (5, 2), (8, 7), (33, 4)])
def test_congruence(n, rows, share):
    """F P Fᵀ, exactly symmetric; zeros of F are skipped, and its last rows may be those of the identity."""
    rng = np.random.default_rng(n)
    P = spd(rng, n)
    F = np.eye(n)
    F[:rows] = rng.normal(0, 1, (rows, n)) * (rng.random((rows, n)) < share)
    expected = F @ P @ F.T
    congruence_of(F, rows, P, np.full((2 * n, n), np.nan))
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-13 * n * max(1.0, np.abs(expected).max()))
    np.testing.assert_array_equal(P, P.T)


def test_mirror():
    P = np.arange(16.0).reshape(4, 4)
    mirror(P)
    np.testing.assert_array_equal(P, P.T)
    assert P[0, 3] == 12.0


def test_wrap():
    rng = np.random.default_rng(0)
    for angle in (*rng.uniform(-50, 50, 100), np.pi, -np.pi, 3 * np.pi, 0.0):
        wrapped = wrap(angle)
        assert -np.pi <= wrapped < np.pi
        # sin and cos are a second opinion on which angle it is; 50 rad has lost a digit of its fraction of a turn.
        np.testing.assert_allclose([np.sin(wrapped), np.cos(wrapped)], [np.sin(angle), np.cos(angle)], atol=2e-14)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("rank", [0, 1, 0.5, 1.0], ids=str)
def test_root_of_a_singular_matrix(n, rank):
    """A of rank k < n, as a noise that enters through few states has; cholesky refuses it."""
    rank = n if rank == 1.0 and isinstance(rank, float) else int(rank * n) if isinstance(rank, float) else rank
    rng = np.random.default_rng(n)
    B = rng.normal(0, 1, (n, rank))
    A = B @ B.T
    U = np.full((n, n), np.nan)
    assert root(A, U, n)
    # Of a pivot that should be zero, some n ε may be left: its root is 1e-8 √n, and it is taken as zero.
    np.testing.assert_allclose(U.T @ U, A, rtol=0, atol=1e-12 * max(1.0, np.abs(A).max()))
    assert np.all(U[np.tril_indices(n, -1)] == 0)


def test_root_of_a_diagonal_is_exact_and_an_indefinite_matrix_is_refused():
    U = np.empty((4, 4))
    assert root(np.diag([4.0, 0.0, 9.0, 0.0]), U, 4)
    np.testing.assert_array_equal(U, np.diag([2.0, 0.0, 3.0, 0.0]))
    for A in (np.diag([1.0, -1e-6]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, np.nan]), np.diag([np.inf, 1])):
        assert not root(A, np.empty((2, 2)), 2)
    # An eigenvalue of -1e-9, where 16 n ε is 7e-15.
    assert not root(np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]]), np.empty((2, 2)), 2)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("extra", [0, 1, 7])
def test_triangularise(n, extra):
    rng = np.random.default_rng(n)
    A = rng.normal(0, 1, (n + extra, n)) * (rng.random((n + extra, n)) < 0.7)
    A[:, n // 2] *= 1e-6
    expected = A.T @ A
    triangularise(A, np.full(n, np.nan))
    np.testing.assert_array_equal(A[np.tril_indices(n + extra, -1, n)], 0.0)
    assert np.all(np.diag(A) >= 0)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.all(np.abs(A.T @ A - expected) <= 1e-14 * (n + extra) * scale)


def test_triangularise_keeps_the_digits_that_the_product_would_lose():
    """[1 1; 0 1e-9]: the product's second pivot, 1e-18 beside 1, has no digit left."""
    A = np.array([[0.6, 0.6], [0.0, 1e-9], [0.8, 0.8]])
    triangularise(A, np.empty(2))
    np.testing.assert_allclose(A[0], [1.0, 1.0], rtol=1e-15)
    np.testing.assert_allclose(A[1, 1], 1e-9, rtol=1e-6)


@pytest.mark.parametrize("n", SIZES)
def test_remove_takes_a_square_off(n):
    rng = np.random.default_rng(n)
    A, v = spd(rng, n), rng.normal(0, 0.2, n)
    R = np.linalg.cholesky(A + np.outer(v, v)).T.copy()
    assert remove(R, n, v.copy())
    np.testing.assert_allclose(R, np.linalg.cholesky(A).T, rtol=0, atol=TOLERANCE * np.abs(A).max())


def test_remove_refuses_what_is_not_there():
    assert not remove(np.eye(2), 2, np.array([1.0, 0.0]))
    assert not remove(np.eye(2), 2, np.array([0.8, 0.8]))
    assert not remove(np.eye(2), 2, np.array([0.0, np.nan]))
    assert remove(np.eye(2), 2, np.array([0.6, 0.6]))


@pytest.mark.parametrize("n", SIZES)
def test_unit_factor(n):
    rng = np.random.default_rng(n)
    A = spd(rng, n)
    b = rng.normal(0, 1, n)
    L, d, solved = A.copy(), np.diag(A).copy(), b.copy()
    unit_factor(L, d, n)
    L = np.tril(L, -1) + np.eye(n)
    np.testing.assert_allclose(L @ np.diag(d) @ L.T, A, rtol=TOLERANCE, atol=TOLERANCE)
    solve_unit(L, n, solved)
    np.testing.assert_allclose(solved, np.linalg.solve(L, b), rtol=TOLERANCE, atol=TOLERANCE)


def test_unit_factor_of_rows_without_variance():
    A = np.array([[4.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 9.0]])
    L, d = A.copy(), np.diag(A).copy()
    unit_factor(L, d, 3)
    np.testing.assert_array_equal(d, [4.0, 0.0, 8.0])
    np.testing.assert_array_equal(np.tril(L, -1), [[0, 0, 0], [0, 0, 0], [0.5, 0, 0]])
