"""Intervals hold what they say, on series that are white, correlated, or of heavy tails."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm, t
from statsmodels.stats.proportion import proportion_confint

from estimators.diagnostics.intervals import (
    N_COSINES,
    Interval,
    correlation_interval,
    long_run_variance,
    mean_interval,
    scale_interval,
    share_interval,
)

RUNS, STEPS = 400, 1000
LEAST = 0.95 - 4 * np.sqrt(0.95 * 0.05 / RUNS)
"""Share of intervals that hold the truth, four deviations below 95 %."""


def series(kind: str, seed: int) -> tuple[np.ndarray, float]:
    """Values of mean 0 and variance 1, and their correlation with the next."""
    rng = np.random.default_rng(seed)
    if kind == "heavy":
        return rng.standard_t(5, STEPS) / np.sqrt(5 / 3), 0.0
    rho = {"white": 0.0, "correlated": 0.7, "alternating": -0.7}[kind]
    white = np.sqrt(1 - rho**2) * rng.standard_normal(STEPS + 200)
    return lfilter([1.0], [1.0, -rho], white)[200:], rho


@pytest.mark.parametrize("kind", ["white", "correlated", "alternating", "heavy"])
def test_nineteen_of_twenty_intervals_hold_the_truth(kind):
    half = norm.ppf(0.95)
    inside = 0.90
    if kind == "heavy":
        inside = 1.0 - 2.0 * t.sf(half * np.sqrt(5 / 3), 5)
    held = np.zeros(4)
    for seed in range(RUNS):
        e, rho = series(kind, seed)
        found = (
            (mean_interval(e), 0.0),
            (scale_interval(e**2), 1.0),
            (share_interval(np.abs(e) <= half, e), inside),
            (correlation_interval(e), rho),
        )
        held += [interval.low <= truth <= interval.high for interval, truth in found]
    # An estimate of the fourth moment from 1000 values of heavy tails is itself low in the median.
    assert np.all(held / RUNS > LEAST - (0.03 if kind == "heavy" else 0.0)), held / RUNS


def test_the_interval_is_as_wide_as_the_correlation_asks():
    """The mean of a series with correlation 0.7 has a deviation √((1 + 0.7) / (1 - 0.7)) times that of a white one."""
    widths = {}
    for kind in ("white", "correlated"):
        found = [mean_interval(series(kind, seed)[0]) for seed in range(RUNS)]
        widths[kind] = np.mean([(one.high - one.low) ** 2 for one in found])
    # A mean of 400 chi-squares of 12 has a deviation of 2 %.
    assert widths["correlated"] / widths["white"] == pytest.approx(1.7 / 0.3, rel=0.12)
    assert widths["white"] == pytest.approx((2 * t.ppf(0.975, N_COSINES)) ** 2 / STEPS, rel=0.08)


@pytest.mark.parametrize("kind", ["white", "correlated", "alternating"])
def test_a_correlation_is_as_uncertain_as_bartlett_says(kind):
    """Its variance is (1 - ρ²) / n for a first-order autoregression."""
    found = [correlation_interval(series(kind, seed)[0]) for seed in range(RUNS)]
    half = t.ppf(0.975, N_COSINES)
    variance = np.mean([((one.high - one.low) / (2 * half)) ** 2 for one in found])
    assert variance == pytest.approx((1 - series(kind, 0)[1] ** 2) / STEPS, rel=0.1)


def test_the_projections_are_on_cosines():
    x = np.random.default_rng(3).standard_normal(50) + 7.0
    steps = np.arange(50) + 0.5
    own = [np.sqrt(2 / 50) * np.sum(x * np.cos(np.pi * j * steps / 50)) for j in range(1, N_COSINES + 1)]
    variance, degrees = long_run_variance(x)
    assert degrees == N_COSINES and variance == pytest.approx(np.mean(np.square(own)), rel=1e-12)
    assert long_run_variance(x[:9])[1] == 4


def test_a_share_has_wilsons_interval():
    """Of values whose squares alternate, so that they count as independent, with Student's t in the normal's place."""
    like = np.tile([1.0, 2.0], 50)
    alpha = 2 * norm.sf(t.ppf(0.975, N_COSINES))
    for share in (1.0, 0.0, 0.5):
        inside = np.full(100, bool(share)) if share != 0.5 else np.tile([True, False], 50)
        low, high = proportion_confint(100 * share, 100, alpha, "wilson")
        assert share_interval(inside, like) == pytest.approx((share, low, high), abs=1e-12)


def test_what_never_changes_is_worth_as_little_as_the_values_it_is_told_of():
    """A slow error that is always inside its band: one excursion is not a thousand readings."""
    slow = np.sin(np.linspace(0.0, 3.0, STEPS))
    white = np.random.default_rng(1).standard_normal(STEPS)
    always = np.ones(STEPS, bool)
    assert share_interval(always, slow).low < 0.8 < 0.99 < share_interval(always, white).low
    # So is one whose sign alternates about it.
    assert share_interval(always, slow * np.tile([1.0, -1.0], STEPS // 2)).low < 0.8
    assert all(0.0 <= share_interval(~always[:n], like[:n]).low for n in range(8, 400) for like in (slow, white))


def test_few_values_have_no_interval():
    for found in (mean_interval(np.ones(7)), scale_interval(np.ones(7)), share_interval(np.ones(7, bool), np.ones(7))):
        assert found.value == 1.0 and np.isnan(found.low) and np.isnan(found.high)
    for found in (
        mean_interval(np.ones(0)),
        share_interval(np.ones(0, bool), np.ones(0)),
        correlation_interval(np.ones(9)),
    ):
        assert np.isnan(found).all()


def test_beyond_is_all_of_it():
    assert Interval(2.0, 1.3, 3.0).beyond(0.8, 1.25) and Interval(0.5, 0.2, 0.7).beyond(0.8, 1.25)
    assert not Interval(2.0, 1.2, 3.0).beyond(0.8, 1.25) and not Interval(2.0, np.nan, np.nan).beyond(0.8, 1.25)
