"""Sensors held out, and the open loop, where the answer is known in closed form."""

import numpy as np
import pytest

from estimators.diagnostics.calibration import BANDS
from estimators.diagnostics.sensitivity.held_out import held_out
from estimators.log import Log
from estimators.tuning import Tuning
from tests.models import level_model

Q, R_A, R_B = 0.04, 0.25, 0.5
PREDICTED = Q / 2.0 * (1.0 + np.sqrt(1.0 + 4.0 * R_A / Q))
"""P before a reading of `a` in the steady state: the positive root of P² - Q P - Q R = 0."""
KEPT = R_A / (PREDICTED + R_A)
"""Share of an error that a reading of `a` leaves, and the correlation of one error with the next."""


WALK = level_model({"a": R_A, "b": R_B}, Q, state="x", std=float(np.sqrt(PREDICTED)))

N = 20_000


def walk(bias: float = 0.0, truth: bool = True) -> tuple[Log, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    # The first reading is of the prior, the others of a second more each.
    steps = np.concatenate(([np.sqrt(PREDICTED)], np.full(N - 1, np.sqrt(Q)))) * rng.normal(size=N)
    x = np.cumsum(steps)
    a = x + np.sqrt(R_A) * rng.normal(size=N) + bias
    b = x + np.sqrt(R_B) * rng.normal(size=N)
    log = Log.of(WALK)
    t = np.arange(N, dtype=float)
    log.add("a", t, a)
    log.add("b", t, b)
    if truth:
        log.add_truth(t, x=x)
    return log, x, a, b


@pytest.fixture(scope="module")
def found():
    log, x, a, b = walk()
    return held_out("ekf", WALK, Tuning.of(WALK), log), x, a, b


def test_a_sensor_is_predicted_with_the_spread_that_the_others_leave(found):
    result, *_ = found
    row = result.rows[1]
    assert (row.row, row.sensor, row.unit, row.n) == ("b", "b", "m", N)
    # b comes after a of the same time: P⁺ + R_b.
    variance = KEPT * PREDICTED + R_B
    # Five standard errors of a mean square of correlated normal values; only the part P⁺ is correlated, by KEPT a step.
    rho = (KEPT * PREDICTED / variance) ** 2 * KEPT**2 / (1.0 - KEPT**2)
    error = np.sqrt(2.0 / N * (1.0 + 2.0 * rho))
    assert row.rms**2 == pytest.approx(variance, rel=5.0 * error)
    assert abs(row.bias) < 5.0 * np.sqrt(variance / N * (1.0 + 2.0 * KEPT / (1.0 - KEPT)))
    for band, share in zip(BANDS, row.coverage, strict=True):
        assert share == pytest.approx(band, abs=5.0 * np.sqrt(band * (1.0 - band) / N * (1.0 + 2.0 * rho)))
    assert not row.worse


def test_the_open_loop_predicts_the_prior_for_ever(found):
    result, x, a, b = found
    for row, readings in zip(result.rows, (a, b), strict=True):
        assert row.open_loop == pytest.approx(np.sqrt(np.mean(readings**2)), rel=1e-12)
    (state,) = result.states
    assert state.open_loop == pytest.approx(np.sqrt(np.mean(x**2)), rel=1e-12)
    assert state.filter < 0.1 * state.open_loop
    assert not state.worse


def test_a_filter_that_makes_a_state_worse_than_no_filter_is_told():
    log, x, *_ = walk(bias=1000.0)
    tuning = Tuning.of(WALK).set("use.b", False)
    result = held_out("ekf", WALK, tuning, log)
    (state,) = result.states
    assert state.filter > 900.0 > state.open_loop
    assert state.worse
    # What a says of b is worse than nothing, too; without a nothing is left to predict a with.
    a, b = result.rows
    assert b.worse and b.rms > 900.0
    assert not a.worse and a.rms == pytest.approx(a.open_loop, rel=1e-12)
