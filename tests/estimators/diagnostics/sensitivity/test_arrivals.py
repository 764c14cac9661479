"""Rates, gaps and lateness of readings whose times are given."""

import numpy as np

from estimators.diagnostics.sensitivity.checklist import arrivals, dimension, spread_error
from estimators.log import READING, Events, Log
from tests.models import level_model

MODEL = level_model({"fast": 1.0, "silent": 1.0}, 1.0, state="x")


def log_of(times, values, late=None) -> Log:
    t = np.round(np.asarray(times) * 1e9).astype(np.int64)
    arrival = t if late is None else t + np.round(np.asarray(late) * 1e9).astype(np.int64)
    n = t.size
    log = Log.of(MODEL)
    log.extend(Events(t, arrival, np.full(n, READING, np.int8), np.zeros(n, np.int32), np.array(values)[:, None]))
    return log


def test_rate_gap_and_what_is_missing():
    # Ten a second for two seconds, of which 0.5 to 0.8 s are not there and one has no value: 21 places, 16 values.
    times = np.array([k * 0.1 for k in range(21) if k not in (5, 6, 7, 8)])
    values = np.where(np.isclose(times, 1.5), np.nan, 1.0)
    fast, silent = arrivals(MODEL, log_of(times, values))
    assert fast.n == 16
    assert np.isclose(fast.period, 0.1) and np.isclose(fast.rate, 10.0)
    assert np.isclose(fast.gap, 0.5) and np.isclose(fast.gap_at, 0.4)
    assert np.isclose(fast.missing, 5 / 21)
    assert np.isnan(fast.lateness).all()
    assert silent.n == 0 and np.isnan(silent.rate) and np.isnan(silent.gap)


def test_lateness_is_arrival_less_measured_time():
    late = np.linspace(0.0, 0.2, 101)
    fast, _ = arrivals(MODEL, log_of(np.arange(101) * 1.0, np.ones(101), late))
    np.testing.assert_allclose(fast.lateness, [0.1, 0.198, 0.2], atol=1e-9)


def test_arithmetic_of_the_dimension():
    found = dimension(MODEL, 50.0, 2e-3, covariance=True)
    assert found.flops == 4.0 + 6.0 and found.memory == 8.0
    assert np.isclose(found.share, 0.1) and found.passes
    # n³ seconds: ten times the work at 10^(1/3) the size.
    assert np.isclose(found.largest, 10.0 ** (1.0 / 3.0))
    assert not dimension(MODEL, 50.0, 2e-2, covariance=True).passes
    # The spread of the σ of so many members, drawn: to five of its own standard errors over 4000 draws.
    drawn = np.random.default_rng(0).normal(size=(4000, found.members)).std(axis=1, ddof=1)
    assert np.isclose(drawn.std(), spread_error(found.members), rtol=5.0 / np.sqrt(2.0 * 4000.0) + 0.01)
    assert np.isclose(spread_error(found.members), 0.1, rtol=1e-9)
