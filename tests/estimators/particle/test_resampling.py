"""Resampling: the right number of children, unbiased, with the variances that the schemes promise, in any split."""

import numpy as np
import pytest

from estimators.numerics.random import key_of
from estimators.particle.resampling import (
    MULTINOMIAL,
    RESIDUAL,
    STRATIFIED,
    SYSTEMATIC,
    ancestors_of,
    descend,
    drawn_children,
    points_below,
    strata_children,
)

SCHEMES = (SYSTEMATIC, STRATIFIED, RESIDUAL, MULTINOMIAL)
N = 40


def children(scheme, w, draw, cuts=()):
    n = w.size
    key, out = np.uint64(key_of(7, draw, scheme)), np.empty(n)
    if scheme > STRATIFIED:
        drawn_children(scheme, key, w.copy(), w.sum(), out)
        return out
    scale = n / w.sum()
    points = [float(np.sum(w[:a])) * scale for a in (0, *cuts)] + [float(n)]
    for k, (a, b) in enumerate(zip((0, *cuts), (*cuts, n), strict=True)):
        strata_children(scheme, key, w[a:b], points[k], points[k + 1], scale, out[a:b])
    return out


@pytest.fixture(scope="module")
def weights():
    return np.random.default_rng(0).exponential(size=N) ** 2 * 3.0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_children_are_unbiased_and_complete(scheme, weights):
    counts = np.array([children(scheme, weights, draw) for draw in range(2000)])
    assert np.all(counts.sum(axis=1) == N) and np.all(counts >= 0)
    expected = N * weights / weights.sum()
    # No scheme's counts vary more than multinomial ones do, expected·(1 - w).
    error = np.sqrt(expected * (1 - expected / N) / len(counts))
    assert np.all(np.abs(counts.mean(axis=0) - expected) < 5 * error + 1e-12)
    if scheme == SYSTEMATIC:
        assert np.all(np.abs(counts - expected) < 1)
    if scheme == STRATIFIED:
        assert np.all(np.abs(counts - expected) < 2)
    if scheme == RESIDUAL:
        assert np.all(counts >= np.floor(expected))
    if scheme == MULTINOMIAL:
        # A sample variance of 2000 near-normal counts is right to 5·√(2/2000) = 16 %, more for rare ones.
        often = expected > 0.5
        ratio = counts.var(axis=0)[often] / (expected * (1 - expected / N))[often]
        assert np.all(np.abs(ratio - 1) < 0.25)


def test_the_schemes_vary_in_their_published_order(weights):
    f = np.arange(N, dtype=float)
    spread = [np.var([children(scheme, weights, draw) @ f for draw in range(2000)]) for scheme in SCHEMES]
    # Stratified and residual never vary more than multinomial: Douc & Cappé (2005), theorems 1 and 2.
    assert spread[STRATIFIED] < spread[MULTINOMIAL] and spread[RESIDUAL] < spread[MULTINOMIAL]
    assert spread[SYSTEMATIC] < spread[MULTINOMIAL]


@pytest.mark.parametrize("scheme", (SYSTEMATIC, STRATIFIED))
def test_runs_fill_the_ancestors_of_their_own_points(scheme, weights):
    """Runs from the last to the first, as threads may do them: as many as in one, as NumPy repeats members by them."""
    cuts = (0, 7, 8, 31, N)
    scale = N / weights.sum()
    for draw in range(20):
        key, counts = np.uint64(key_of(7, draw, scheme)), children(scheme, weights, draw, cuts=cuts[1:-1])
        assert np.array_equal(counts, children(scheme, weights, draw))
        points = [float(np.sum(weights[:a])) * scale for a in cuts[:-1]] + [float(N)]
        begins = [int(points_below(scheme, key, point)) for point in points]
        ancestors = np.full(N, -1)
        for k in reversed(range(4)):
            ancestors_of(counts[cuts[k] : cuts[k + 1]], cuts[k], ancestors[begins[k] : begins[k + 1]])
        np.testing.assert_array_equal(ancestors, np.repeat(np.arange(N), counts.astype(int)))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_weightless_particles_have_no_children(scheme):
    w = np.zeros(N)
    w[[3, 17]] = 1.0, 3.0
    for draw in range(50):
        assert set(np.flatnonzero(children(scheme, w, draw))) <= {3, 17}


@pytest.mark.parametrize("width", (1, 3, 40))
@pytest.mark.parametrize("n", (1, 2, 5, 6, 300))
def test_children_stand_in_the_order_of_their_ancestors(n, width):
    """Beside NumPy's repeat, which copies; counts of all kinds, the whole of them at either end among them."""
    rng = np.random.default_rng(n)
    every = [np.eye(n)[k] * n for k in (0, n // 2, n - 1)]
    every += [rng.multinomial(n, rng.dirichlet(np.full(n, a))) for a in (0.1, 1, 9)]
    for counts in every:
        rows, ancestors = rng.normal(size=(n, width)), np.full(n, -1)
        expected = np.repeat(rows, counts.astype(int), axis=0)
        ancestors_of(counts.astype(float), 0, ancestors)
        assert np.array_equal(ancestors, np.repeat(np.arange(n), counts.astype(int)))
        lineage, copy = rows[:, :1].copy(), rows.copy()
        for threads in (False, True):
            rows[:], lineage[:] = copy, copy[:, :1]
            descend(ancestors, rows, lineage, threads)
            assert np.array_equal(rows, expected) and np.array_equal(lineage, expected[:, :1])


@pytest.mark.parametrize("scheme", (SYSTEMATIC, STRATIFIED, RESIDUAL))
def test_whole_shares_leave_nothing_to_chance(scheme):
    """Weights of c/N: every stratum of the cumulated weights belongs to one particle, and nothing is left to draw."""
    counts = np.random.default_rng(1).multinomial(N, np.full(12, 1 / 12)).astype(float)
    w = np.concatenate((counts, np.zeros(N - 12)))
    for draw in range(20):
        assert np.array_equal(children(scheme, w, draw), w)


@pytest.mark.parametrize("scheme", (SYSTEMATIC, STRATIFIED))
def test_a_run_ends_where_its_neighbour_begins_whatever_its_own_sum(scheme):
    """Rounding, here as large as half a point: a run has the points between the ends it was given, none below zero."""
    for draw in range(20):
        key, out = np.uint64(key_of(3, draw, scheme)), np.empty(2)
        strata_children(scheme, key, np.array([1.5, 2.0]), 0.0, 4.0, 1.0, out)
        assert out.sum() == 4 and 1 <= out[0] <= 2
        strata_children(scheme, key, np.array([4.5, 0.0]), 0.0, 4.0, 1.0, out)
        assert np.array_equal(out, [4.0, 0.0])
