"""Against statsmodels, and on series with gaps; on innovations of the Nile: tests/textbook.py."""

import numpy as np
import pytest
from scipy.stats import chi2
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.stats.stattools import jarque_bera as their_jarque_bera

from estimators.diagnostics.innovations import jarque_bera, ljung_box


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
