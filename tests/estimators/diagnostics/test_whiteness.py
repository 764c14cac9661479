"""Against statsmodels, on the innovations of a local level model of the Nile, and on series with gaps."""

import numpy as np
import pytest
import statsmodels.api as sm
from scipy.stats import chi2
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.stats.stattools import jarque_bera as their_jarque_bera

from estimators.diagnostics.innovations import jarque_bera, ljung_box
from estimators.fold import fold
from estimators.log import READING, Events
from estimators.tuning import Tuning
from tests.estimators.fit.test_plain import NILE_FLOW
from tests.models import level_model
from tests.support import SECOND, as_log

LEVEL, IRREGULAR = 1469.1, 15098.5
"""Variances of the Nile's level and readings, 10¹⁶ m⁶: Durbin & Koopman, Time Series Analysis by State Space Methods,
2.2.5."""

PRIOR = (1000.0, 500.0)
"""Mean and standard deviation of the level in the first year, the same for both programs: nothing is diffuse."""

GAPS = [3, 20, 21, 22, 70]

AGREE = 1e-6


NILE = level_model({"flow": IRREGULAR}, LEVEL, mean=PRIOR[0], std=PRIOR[1], linear=True)


def innovations_of(series: np.ndarray) -> np.ndarray:
    """Standardised, by our Kalman filter, a year taken as a second."""
    t = SECOND * np.arange(series.size)
    n = series.size
    log = as_log(Events(t, t, np.full(n, READING, np.int8), np.zeros(n, np.int32), series[:, None]))
    track = fold("kf", NILE, Tuning.of(NILE), log)
    return track.innovation[:, 0] / track.innovation_std[:, 0]


def theirs(series: np.ndarray):
    """The results of statsmodels, for the same variances and prior."""
    model = sm.tsa.UnobservedComponents(series, "llevel")
    model.loglikelihood_burn = 0  # its own prior would be diffuse, and the first year say nothing
    model.ssm.initialize_known(np.array([PRIOR[0]]), np.array([[PRIOR[1] ** 2]]))
    return model.filter([IRREGULAR, LEVEL])


@pytest.fixture(scope="module", params=["whole", "with gaps"])
def series(request):
    flows = NILE_FLOW.copy()
    if request.param == "with gaps":
        flows[GAPS] = np.nan
    return flows


def test_innovations_of_the_nile_are_those_of_statsmodels(series):
    """Which gives 0 for a year that is missing."""
    expected, ours = theirs(series).standardized_forecasts_error[0], innovations_of(series)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(series))
    np.testing.assert_allclose(np.nan_to_num(ours), expected, rtol=0, atol=AGREE)


def test_gaps_are_left_out_of_normality_as_statsmodels_does():
    flows = NILE_FLOW.copy()
    flows[GAPS] = np.nan
    ours = innovations_of(flows)
    expected = their_jarque_bera(ours[np.isfinite(ours)])[:2]
    np.testing.assert_allclose(jarque_bera(ours)[:2], expected, rtol=0, atol=AGREE)


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
