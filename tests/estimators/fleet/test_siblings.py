"""Assets beside each other: those that differ are found, and false alarms among them are as many as asked for."""

import numpy as np
import pytest
from scipy.stats import norm

from estimators.errors import EstimatorError
from estimators.fleet.siblings import siblings
from tests.benchmarks.siblings import planted_fleet


def test_mean_and_spread_are_those_of_the_true_values():
    """With deviations of their own; the standard error of a median of n is 1.2533, of a MAD 1.1664, σ / sqrt(n)."""
    rng, n = np.random.default_rng(1), 40_000
    s = rng.uniform(0.5, 2.0, n)
    x = 7.0 + 1.5 * rng.normal(size=n) + s * rng.normal(size=n)
    found = siblings(x, s)
    width = float(np.sqrt(1.5**2 + 2.0**2) / np.sqrt(n))
    assert found.mean == pytest.approx(7.0, abs=3 * 1.2533 * width)
    # A relative error of the total deviation is one of (t² + s²) / t² of t.
    assert found.std == pytest.approx(1.5, rel=3 * 1.1664 / np.sqrt(n) * (1 + (2.0 / 1.5) ** 2))


def test_equal_deviations_have_the_closed_form():
    x = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 109.0])
    found = siblings(x, np.full(9, 0.5))
    # The median is 5 and the median deviation 2, of which 0.5 is the estimates' own.
    std = np.sqrt((2.0 / norm.ppf(0.75)) ** 2 - 0.25)
    assert (found.mean, found.std) == (pytest.approx(5.0, rel=1e-12), pytest.approx(std, rel=1e-12))
    np.testing.assert_allclose(found.z, (x - 5.0) * norm.ppf(0.75) / 2.0, rtol=1e-12, atol=1e-12)
    assert found.differs.tolist() == [False] * 8 + [True]


def test_estimates_that_agree_have_no_spread():
    found = siblings(np.linspace(-0.1, 0.1, 21), np.ones(21))
    assert found.std == 0.0 and not found.differs.any()
    exact = siblings(np.full(9, 3.0), np.zeros(9))
    assert (exact.mean, exact.std) == (3.0, 0.0) and np.all(exact.rate == 1.0)


@pytest.mark.parametrize(("count", "differ"), [(8, 0), (9, 0), (50, 0), (400, 0), (20, 2)])
def test_false_discoveries_of_a_small_fleet_are_as_few(count, differ):
    """Of equal assets any alarm is false. A share of 5 % is right if it lies within three of its standard errors."""
    rng, runs = np.random.default_rng(count + differ), 1000
    shares = np.empty(runs)
    for k in range(runs):
        x = rng.normal(size=count)
        x[:differ] += 6.0
        found = siblings(x, np.zeros(count), rate=0.05).differs
        shares[k] = found[differ:].sum() / max(1, found.sum())
    error = 3.0 * np.sqrt(0.05 * 0.95 / runs)
    assert np.mean(shares) < 0.05 + error
    assert differ or np.mean(shares) > 0.05 - error


def test_the_centre_of_an_even_fleet_is_half_way():
    """Turning the signs round turns the result round."""
    x, s = np.random.default_rng(4).normal(size=8), np.full(8, 0.1)
    one, other = siblings(x, s), siblings(-x, s)
    np.testing.assert_allclose(one.z, -other.z, rtol=1e-9)


def test_the_rate_of_false_discoveries_is_the_one_asked_for():
    """Over 200 fleets of 1,000 assets with 50 that differ, by Benjamini and Hochberg's bound for those that do not."""
    rng, shares = np.random.default_rng(2), []
    for _ in range(200):
        x = rng.normal(size=1000)
        x[:50] += 4.5
        found = siblings(x, np.zeros(1000), rate=0.1).differs
        shares.append(found[50:].sum() / max(1, found.sum()))
    error = np.std(shares) / np.sqrt(200)
    # The 50 widen the spread by some: the rate may be lower, not higher.
    assert 0.05 < np.mean(shares) < 0.1 * 950 / 1000 + 3 * error


def test_faults_of_a_fleet_are_found():
    """10,000 assets whose true levels differ by 0.5, of which 50 are off by 3.5, estimated from 30 measurements."""
    table, wrong = planted_fleet(3.5)
    count = len(table.mean)
    found = siblings(table.mean[:, 0], table.std[:, 0], rate=0.05)
    reported = np.flatnonzero(found.differs)
    # Off by 3.5, in deviations: the power of a test at the least p-value that is reported.
    limit = norm.isf(0.5 * 0.05 * len(reported) / count)
    power = norm.sf(limit - 3.5 / np.hypot(0.5, table.std[0, 0]))
    missed = np.setdiff1d(wrong, reported).size
    assert missed <= 50 * (1 - power) + 3 * np.sqrt(50 * power * (1 - power))
    assert len(np.setdiff1d(reported, wrong)) <= 0.05 * len(reported) + 3 * np.sqrt(0.05 * len(reported))
    # The prior of a new asset.
    assert found.mean == pytest.approx(20.0, abs=0.03) and found.std == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize(
    ("mean", "std", "rate", "text"),
    [
        (np.zeros(9), np.ones(8), 0.05, r"mean has shape \(9,\) and std \(8,\); both must be \(N,\)"),
        (np.zeros(9), np.ones(9), 1.0, "rate is 1; it must be above 0 and below 1"),
        (np.zeros(9), -np.ones(9), 0.05, "a standard deviation is negative"),
        (np.full(9, np.nan), np.ones(9), 0.05, "0 assets have an estimate; 8 are needed"),
    ],
)
def test_what_is_wrong_is_one_line(mean, std, rate, text):
    with pytest.raises(EstimatorError, match=text):
        siblings(mean, std, rate=rate)


def test_assets_without_an_estimate_are_left_out():
    x, s = np.arange(10.0), np.full(10, 0.1)
    x[3] = np.nan
    found = siblings(x, s)
    assert np.isnan(found.rate[3]) and not found.differs[3]
    kept = np.delete(np.arange(10), 3)
    np.testing.assert_array_equal(found.z[kept], siblings(x[kept], s[kept]).z)
