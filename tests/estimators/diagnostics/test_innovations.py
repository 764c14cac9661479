"""Pictures and tests of innovations against statsmodels, NumPy and what is known of a normal variable; on series with
gaps, and on innovations of the Nile: tests/textbook.py.
"""

import numpy as np
import pytest
from scipy.stats import binom, chi2
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.stats.stattools import jarque_bera as their_jarque_bera

from estimators.diagnostics.innovations import (
    autocorrelation,
    flat_range,
    histogram,
    jarque_bera,
    ljung_box,
    memory,
    quantile_pairs,
    rank_histogram,
)
from tests.estimators.diagnostics.test_effects import correlated


def series(phi, n=3000, seed=0):
    return correlated(np.random.default_rng(seed), phi, n)


@pytest.mark.parametrize("phi", [0.0, 0.6, -0.4])
def test_the_autocorrelation_is_that_of_statsmodels_and_numpy(phi):
    tools = pytest.importorskip("statsmodels.tsa.stattools")
    e = 0.3 + series(phi)
    found = autocorrelation(e, 50)
    np.testing.assert_allclose(found.r, tools.acf(e, nlags=50, fft=False)[1:], rtol=1e-10, atol=1e-12)
    z = e - e.mean()
    full = np.correlate(z, z, mode="full")[e.size :] / (z @ z)
    np.testing.assert_allclose(found.r, full[:50], rtol=1e-10, atol=1e-12)
    assert found.bound == pytest.approx(1.959964 / np.sqrt(e.size), rel=1e-6)


def test_missing_values_keep_their_place_in_the_autocorrelation():
    tools = pytest.importorskip("statsmodels.tsa.stattools")
    e = series(0.8)
    e[::7] = np.nan
    # As statsmodels has it, up to what it divides by: it counts pairs, and the others are zero here as there.
    expected = tools.acovf(e, missing="conservative", fft=False, adjusted=False)
    found = autocorrelation(e, 20)
    pairs = np.array([np.sum(np.isfinite(e[k:]) & np.isfinite(e[: e.size - k])) for k in range(21)])
    np.testing.assert_allclose(found.r, (expected[1:21] * pairs[0]) / (expected[0] * pairs[0]), rtol=1e-10)
    assert found.bound == pytest.approx(1.959964 / np.sqrt(pairs[0]), rel=1e-6)


def test_what_has_no_correlation_is_not_a_number():
    assert np.isnan(autocorrelation(np.ones(30), 5).r).all()
    assert np.isnan(autocorrelation(np.array([]), 5).r).all()
    short = autocorrelation(np.array([1.0, -1.0, 2.0]), 5).r
    assert np.isfinite(short[:2]).all() and np.isnan(short[2:]).all()


def test_a_histogram_counts_everything_also_what_lies_beyond():
    e = np.array([-9.0, -3.99, 0.01, 0.2, 4.0, 50.0, np.nan])
    found = histogram(e)
    assert found.counts.sum() == 6 and found.counts[0] == 2 and found.counts[-1] == 2 and found.counts[16] == 2


def test_quantile_pairs_lie_where_statsmodels_puts_them():
    plots = pytest.importorskip("statsmodels.graphics.gofplots")
    e = series(0.0, 41)
    found = quantile_pairs(e)
    expected = plots.ProbPlot(e, a=0.5)  # plotting positions (i - a) / (n + 1 - 2a)
    np.testing.assert_allclose(found[:, 0], expected.theoretical_quantiles, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], expected.sample_quantiles, rtol=1e-12)
    many = quantile_pairs(series(0.0, 20_000))
    assert len(many) <= 60 and many[0, 1] == series(0.0, 20_000).min() and many[-1, 1] == series(0.0, 20_000).max()
    assert len(quantile_pairs(np.full(3, np.nan))) == 0


def test_ranks_are_flat_where_the_prediction_is_right_and_a_u_where_it_is_too_narrow():
    rng = np.random.default_rng(5)
    right, narrow = rank_histogram(rng.normal(0, 1, 5000)), rank_histogram(rng.normal(0, 2, 5000))
    inside = (right.counts > right.low) & (right.counts < right.high)
    # Each is outside with 5 %: of ten, four or more once in a thousand.
    assert inside.sum() >= 7 and right.counts.sum() == 5000
    assert min(narrow.counts[0], narrow.counts[-1]) > narrow.high and narrow.counts[4] < narrow.low
    low, high = flat_range(5000, 10)
    assert binom.cdf(high, 5000, 0.1) - binom.cdf(low, 5000, 0.1) == pytest.approx(0.95, abs=0.005)


def test_how_long_a_correlation_lasts():
    assert memory(0.9 * 0.8 ** np.arange(50)) == 6  # 0.8^5 is 0.328 of the first
    assert memory(np.array([0.5, 0.1])) == 2 and memory(np.full(9, 0.7)) == 9


@pytest.mark.parametrize("kind", ["white", "correlated", "spiky"])
def test_a_broken_series_is_found_by_its_own_test_and_told_as_by_statsmodels(kind):
    e = np.random.default_rng(5).standard_normal(600)
    if kind == "correlated":
        for t in range(1, e.size):
            e[t] = 0.4 * e[t - 1] + np.sqrt(1 - 0.4**2) * e[t]
    elif kind == "spiky":
        e[::40] *= 5.0
    serial, normal = ljung_box(e), jarque_bera(e)
    theirs = acorr_ljungbox(e, lags=[10])
    np.testing.assert_allclose(serial[:2], [theirs.lb_stat.iloc[0], theirs.lb_pvalue.iloc[0]], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(normal[:2], their_jarque_bera(e)[:2], rtol=1e-9, atol=1e-12)
    assert jarque_bera(np.insert(e, [0, 3, 20, 20, 70], np.nan)) == pytest.approx(normal, rel=1e-12)
    assert (serial.p_value < 1e-4) == (kind == "correlated")
    assert (normal.p_value < 1e-4) == (kind == "spiky")


def test_gaps_leave_the_ljung_box_statistic_its_distribution():
    """A third of the values missing, 400 series: the mean of a chi-square of 10 is 10, its deviation √20 / √400."""
    rng = np.random.default_rng(11)
    e = rng.standard_normal((400, 300))
    e[rng.random(e.shape) < 1 / 3] = np.nan
    found = np.array([ljung_box(row, 10).statistic for row in e])
    assert abs(found.mean() - 10) < 4 * np.sqrt(20 / 400)
    # Of the values above the 95 % quantile 20 are expected, give or take 4.4.
    assert abs(np.sum(found > chi2.ppf(0.95, 10)) - 20) < 4 * np.sqrt(400 * 0.05 * 0.95)


@pytest.mark.parametrize("e", [np.zeros(0), np.full(30, np.nan), np.zeros(30), np.array([1.0])])
def test_what_says_nothing_has_no_figure(e):
    for test in (ljung_box(e), jarque_bera(e)):
        assert np.isnan(test.statistic) and np.isnan(test.p_value)


def test_lags_must_be_positive():
    with pytest.raises(ValueError, match="lags is 0; it must be 1 or more"):
        ljung_box(np.zeros(9), 0)
