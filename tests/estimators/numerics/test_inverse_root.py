"""The inverse root's action on a vector: against LAPACK, and in closed form where the matrix has rank one."""

import numpy as np
import pytest

from estimators.numerics import inverse_root
from estimators.numerics.inverse_root import root_action, scratch_of

ORDERS = (1, 2, 3, 4, 7, 8, 9, 13, 24, 40, 65)


def act(A, b, g, inverse):
    n = len(A)
    x = b.copy()
    scratch = np.full(scratch_of(n) + 1, 7.0)
    product = root_action(A.copy(), n, np.empty(n), x, g.copy(), inverse, scratch)
    assert scratch[-1] == 7.0, "it wrote behind its scratch"
    return x, product


@pytest.mark.parametrize("rule", range(inverse_root._BLOCKS))
def test_every_rule_is_good_to_rounding_where_it_is_used(rule):
    """A sum of up to 144 positive terms: rounding of a few ε, and the rule's own error of 1 ε."""
    x = np.geomspace(1.0, inverse_root._UP_TO[rule], 2001)
    found = np.sum(inverse_root._WEIGHTS[rule] / (x[:, None] + inverse_root._SHIFTS[rule]), axis=1)
    np.testing.assert_allclose(found * np.sqrt(x), 1.0, rtol=0, atol=3e-15)


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("rank", [1, 3, 200])
@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e4])
def test_the_action_is_that_of_the_eigenvectors(n, rank, inverse, size):
    """Both are backward stable: off by a small multiple of n ε of the largest eigenvalue, by f's slope of at most 1.

    The second function is a difference quotient of the first, whose error of 1 ε oscillates: its slope is up to the
    square of the rule's count, 8 to 24, as large (Markov's inequality).
    """
    rng = np.random.default_rng([n, rank])
    Z = rng.standard_normal((rank, n))
    A = size * Z.T @ Z / rank
    b, g = rng.standard_normal((2, n))
    values, vectors = np.linalg.eigh(A)
    grown = 1 + np.maximum(values, 0)
    f = 1 / np.sqrt(grown) if inverse else 1 / (grown + np.sqrt(grown))
    tolerance = 1e-14 * n * grown[-1] + (0.0 if inverse else 1.5e-13)
    x, product = act(A, b, g, inverse)
    np.testing.assert_allclose(x, vectors * f @ (vectors.T @ b), rtol=0, atol=tolerance * np.linalg.norm(b))
    expected = vectors.T @ b / grown @ (vectors.T @ g)
    assert product == pytest.approx(expected, rel=0, abs=tolerance * np.linalg.norm(b) * np.linalg.norm(g))


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("size", [1e-20, 1e-3, 1.0, 1e6, 1e12, 1e20, 1e30, 1e40])
def test_one_direction_far_larger_than_the_others(n, size):
    """A = s q qᵀ: f(A) b = b - q qᵀ b (1 - 1/√(1+s)). What is off by ε s beside 1 may shrink, and must not grow."""
    rng = np.random.default_rng(n)
    q, b, g = rng.standard_normal((3, n))
    q /= np.linalg.norm(q)
    x, _ = act(size * np.outer(q, q), b, g, True)
    along = q @ b
    tolerance = 1e-14 * n * np.linalg.norm(b)
    assert np.linalg.norm(x) <= np.linalg.norm(b) + tolerance
    if size <= 1e12:
        expected = b - q * along * (1 - 1 / np.sqrt(1 + size))
        np.testing.assert_allclose(x, expected, rtol=0, atol=tolerance * max(1.0, size))
    assert abs(q @ x) <= abs(along) / np.sqrt(1 + size) + tolerance


def test_numbers_that_are_not_finite_are_told():
    for bad in (np.nan, np.inf, 1e200):
        A = np.full((3, 3), bad)
        assert np.isnan(act(A, np.ones(3), np.ones(3), True)[1])
