"""The inverse root's action on eight vectors: against LAPACK, and in closed form where the matrix has rank one."""

import numpy as np
import pytest

from estimators.numerics import inverse_root
from estimators.numerics.inverse_root import action_at, root_action
from estimators.numerics.jit import jit
from estimators.numerics.simd_ir import LANES
from estimators.numerics.simd_lanes import weighted_gram
from estimators.numerics.workspace import size_of, start_of

ORDERS = (1, 2, 3, 4, 7, 8, 9, 13, 24, 40, 65)


@jit
def in_lanes(A, n, b, g, inverse, scratch, product):
    root_action(A, n, b, g, inverse, action_at(start_of(scratch), n), product)


def act(A, b, g, inverse):
    """f(A) b and bᵀ (I + A)⁻¹ g of matrices (LANES, n, n) and vectors (LANES, n), of which one triangle is read."""
    n = A.shape[1]
    upper = np.where(np.triu(np.ones((n, n), bool)), A, np.nan)
    x = b.T.copy()
    scratch, product = np.full(size_of(action_at, n) + 1, 7.0), np.empty(LANES)
    in_lanes(upper.reshape(LANES, n * n).T.copy(), n, x, g.T.copy(), inverse, scratch, product)
    assert scratch[-1] == 7.0, "it wrote behind its scratch"
    return x.T, product


@pytest.mark.parametrize("rule", range(inverse_root._RULES))
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
    Z = rng.standard_normal((LANES, rank, n))
    A = size * Z.swapaxes(1, 2) @ Z / rank
    b, g = rng.standard_normal((2, LANES, n))
    x, product = act(A, b, g, inverse)
    for k in range(LANES):
        values, vectors = np.linalg.eigh(A[k])
        grown = 1 + np.maximum(values, 0)
        f = 1 / np.sqrt(grown) if inverse else 1 / (grown + np.sqrt(grown))
        tolerance = 1e-14 * n * grown[-1] + (0.0 if inverse else 1.5e-13)
        length = np.linalg.norm(b[k])
        np.testing.assert_allclose(x[k], vectors * f @ (vectors.T @ b[k]), rtol=0, atol=tolerance * length)
        expected = vectors.T @ b[k] / grown @ (vectors.T @ g[k])
        assert product[k] == pytest.approx(expected, rel=0, abs=tolerance * length * np.linalg.norm(g[k]))


def test_a_lane_depends_on_no_other():
    """Of matrices with one largest eigenvalue, and so one rule: to the last bit, beside zeros and beside NaN."""
    rng = np.random.default_rng(4)
    Z, (b, g) = rng.standard_normal((LANES, 9, 13)), rng.standard_normal((2, LANES, 13))
    A = Z.swapaxes(1, 2) @ Z
    A /= np.linalg.eigvalsh(A)[:, -1, None, None]
    x, product = act(A, b, g, True)
    for other in (0.0, np.nan):
        beside = np.full_like(A, other)
        beside[3] = A[3]
        alone, its = act(beside, b, g, True)
        np.testing.assert_array_equal(alone[3], x[3])
        assert its[3] == product[3]


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("size", [1e-20, 1e-3, 1.0, 1e6, 1e12, 1e20, 1e30, 1e40])
def test_one_direction_far_larger_than_the_others(n, size):
    """A = s q qᵀ: f(A) b = b - q qᵀ b (1 - 1/√(1+s)). What is off by ε s beside 1 may shrink, and must not grow."""
    rng = np.random.default_rng(n)
    q, b, g = rng.standard_normal((3, LANES, n))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    x, _ = act(size * q[:, :, None] * q[:, None], b, g, True)
    along = np.sum(q * b, axis=1)
    tolerance = 1e-14 * n * np.linalg.norm(b, axis=1)
    assert np.all(np.linalg.norm(x, axis=1) <= np.linalg.norm(b, axis=1) + tolerance)
    if size <= 1e12:
        expected = b - q * along[:, None] * (1 - 1 / np.sqrt(1 + size))
        assert np.all(np.abs(x - expected) <= tolerance[:, None] * max(1.0, size))
    assert np.all(np.abs(np.sum(q * x, axis=1)) <= np.abs(along) / np.sqrt(1 + size) + tolerance)


def test_numbers_that_are_not_finite_are_told():
    for bad in (np.nan, np.inf, 1e200):
        A = np.ones((LANES, 3, 3))
        A[5] = bad
        product = act(A, np.ones((LANES, 3)), np.ones((LANES, 3)), True)[1]
        np.testing.assert_array_equal(np.isnan(product), np.arange(LANES) == 5)


@jit
def gram_in_lanes(own, tapers, Z, G):
    weighted_gram(own.size, own, tapers, Z, Z.shape[1], G)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 8, 13])
def test_gram_of_each_lanes_weights(n):
    """Sums of 5 products of order 1, in another order."""
    rng = np.random.default_rng(n)
    Z, tapers, own = rng.standard_normal((9, n)), rng.uniform(0, 1, (5, LANES)), np.array([0, 2, 3, 7, 8])
    G = np.empty((n * n, LANES))
    gram_in_lanes(own, tapers, Z, G)
    expected = np.einsum("kl,ki,kj->ijl", tapers, Z[own], Z[own])
    upper = np.triu_indices(n)
    np.testing.assert_allclose(G.reshape(n, n, LANES)[upper], expected[upper], rtol=0, atol=1e-14)
