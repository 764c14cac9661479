"""Diagnostics must be able to fail: inside their bounds for a model that fits, outside for one that does not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.diagnostics.health import (
    MAX_ROWS_PER_READING,
    MIN_WINDOW_EVENTS,
    HealthPolicy,
    assess,
    chi_square_bounds,
    nis_bounds,
)
from estimators.diagnostics.score import score
from estimators.fold import fold
from estimators.log import READING, RESET, TICK, TRUTH, Events
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.track import DIVERGED, FAILED, GATED, HELD_OUT, MISSING, NONE, SUSPECT, TRACKING, USED, Track
from estimators.tuning import Tuning
from tests.models import first_state, level_model, unchanged
from tests.support import SECOND, as_log, log_of
from tests.support import folded as advanced

MOTOR = MODELS["motor_winding"]
F = np.array([[1.0, 1.0], [0.0, 1.0]])
Q = np.diag([0.01, 0.001])
RUNS, STEPS = 200, 40


def simulated(seed, bias=0.0):
    """A run of the motor drawn from its own model; the truth starts from the prior, as the filter believes."""
    rng = np.random.default_rng(seed)
    x = np.array([35.0, 0.0]) + rng.normal(0, 1, 2) * [5.0, 1.0]
    batch = [Events.one(0, 0, TICK, 0, (), 1)]
    for k in range(1, STEPS + 1):
        x = F @ x + rng.normal(0, np.sqrt(np.diag(Q)))
        batch.append(Events.one(k * SECOND, 0, READING, 0, x[0] + bias + rng.normal(0, 2.0), 1))
        batch += [Events.one(k * SECOND, 0, TRUTH, j, x[j], 1) for j in range(2)]
    return as_log(Events.concat(batch, 1))


def averages(estimator, tuning, bias=0.0):
    """NIS summed over all runs and steps; NEES of the last step summed over the runs (independent between runs)."""
    nis = nees = 0.0
    for seed in range(RUNS):
        log = simulated(seed, bias)
        folded = advanced(estimator, MOTOR, log, tuning)
        nis += folded.track.nis[folded.track.verdict == USED].sum()
        mean, cov = folded.moments()
        error = mean - log.events.value[-2:, 0]
        nees += error @ np.linalg.solve(cov, error)
    return nis, nees


# The chance that a sum of chi-squares leaves these bounds is 1e-4; the seeds are fixed, so it does not flicker.
TAIL = 5e-5


# The other Gaussian filters have the moments and innovations of `kf` where the model is linear.
@pytest.mark.parametrize("estimator", ["kf", "kf-steady"])
def test_a_model_that_fits_is_inside_its_bounds(estimator):
    nis, nees = averages(estimator, Tuning.of(MOTOR))
    assert chi2.ppf(TAIL, RUNS * STEPS) < nis < chi2.ppf(1 - TAIL, RUNS * STEPS)
    assert chi2.ppf(TAIL, 2 * RUNS) < nees < chi2.ppf(1 - TAIL, 2 * RUNS)


@pytest.mark.parametrize(
    ("variances", "bias", "tail"),
    [
        ({"R.winding": 2.0}, 0.0, 1 - TAIL),
        ({"R.winding": 8.0}, 0.0, TAIL),
        ({"Q.rate": 1e-6, "Q.temperature": 1e-6}, 0.0, 1 - TAIL),
        ({}, 3.0, 1 - TAIL),
    ],
    ids=["R too small", "R too large", "Q too small", "a biased sensor"],
)
def test_what_is_wrong_is_outside(variances, bias, tail):
    """Q and bias in NEES alone: where R rules S, the innovations hardly show them (NIS 2.8 % too high for Q)."""
    tuning = Tuning.of(MOTOR)
    for key, value in variances.items():
        tuning = tuning.set(key, value)
    nis, nees = averages("kf", tuning, bias)
    side = 1.0 if tail > 0.5 else -1.0
    for total, dof in ((nis, RUNS * STEPS), (nees, 2 * RUNS))[0 if "R.winding" in variances else 1 :]:
        assert side * total > side * chi2.ppf(tail, dof) * (10.0 if "Q.rate" in variances else 1.0)


def test_bounds_are_the_published_quantiles():
    """Chi-square 95 %: 0.0010 to 5.0239 for one degree of freedom, 74.222 to 129.561 for a hundred (tables)."""
    low, high = nis_bounds(np.array([1]), 1)
    assert (round(low, 4), round(high, 4)) == (0.0010, 5.0239)
    low, high = nis_bounds(np.array([60, 40]), 50)
    assert (round(low * 50, 3), round(high * 50, 3)) == (74.222, 129.561)
    table = chi_square_bounds(100)
    assert (round(table.low[100], 3), round(table.high[100], 3)) == (74.222, 129.561)
    assert len(table.low) == 101


def test_true_states_come_in_blocks():
    """40 states, truth from 0 on and from 32 on, partly unknown, and one event with a single value of old.

    The filter stays at its prior, mean j/10 and 95 % band 1.96 * 0.5, so every number follows by hand.
    """
    names = [f"s{j}" for j in range(40)]
    states = tuple(State(name, "", mean=j / 10, std=0.5, circular=j == 33) for j, name in enumerate(names))
    many = level_model({"compass": 0.01}, 0.0, state="s0", states=states, linear=True)
    nan = np.nan
    low, high = np.full(32, nan), np.full(32, nan)
    low[0], low[5], low[31] = 0.3, 1.5, 3.1  # errors -0.3, -1, 0
    high[0], high[1], high[7] = nan, -2.8, 4.3  # state 33: 3.3 + 2.8 = 6.1 is -0.1832 the short way; state 39: -0.4
    batch = [
        Events.one(0, 0, TRUTH, 0, low, 32),
        Events.one(0, 0, TRUTH, 32, high, 32),
        Events.one(SECOND, 0, TRUTH, 5, 0.5 - 2.0, 32),  # error 2, outside the band as the -1 before it
        Events.one(SECOND, 0, TRUTH, 0, nan, 32),
    ]
    log = as_log(Events.concat(batch, many.width))
    fits = score(fold("kf", many, Tuning.of(many), log), log.events, many).states
    expected = {
        "s0": (0.3, 1.0),
        "s5": (np.sqrt((1.0 + 4.0) / 2), 0.0),
        "s31": (0.0, 1.0),
        "s33": (2 * np.pi - 6.1, 1.0),
        "s39": (0.4, 1.0),
    }
    assert list(fits) == list(expected)
    for name, (rmse, coverage) in expected.items():
        # The circular mean 3.3 is kept as 3.3 - 2π: one rounding of numbers near 6.
        assert fits[name].rmse == pytest.approx(rmse, rel=1e-12, abs=1e-14) and fits[name].coverage == coverage


COMPASS = StateSpaceModel(
    name="compass",
    title="compass",
    states=(State("heading", "rad", mean=-3.1, std=0.1, circular=True),),
    noises=(Noise("heading", "rad²/s", 0.01),),
    sensors=(Sensor("compass", (Row("compass", "rad", 0.01, circular=True),), h=first_state),),
    f=unchanged,
    linear=True,
)


# Health


def history(values, kind=READING, step=1.0):
    """Events `step` seconds apart, one a value."""
    return log_of(1, *((k * step, kind, value) for k, value in enumerate(values)))


def healths(log, policy=None, gate=None):
    return fold("kf", COMPASS, Tuning.of(COMPASS).set("gate", gate), log, policy=policy).health


GOOD = list(-3.1 + 0.1 * np.random.default_rng(0).normal(0, 1, 60))


def test_readings_too_far_off_are_suspect_then_diverge():
    """White steps of `scale` sigmas: mean NIS near scale². The tests speak long before; diverged at ten times 1."""
    rng = np.random.default_rng(1)
    for scale, expected in ((1.0, TRACKING), (2.2, SUSPECT), (6.0, DIVERGED)):
        values = -3.1 + scale * 0.127 * rng.choice([-1.0, 1.0], 80)
        track = fold("kf", COMPASS, Tuning.of(COMPASS), history(values))
        assert track.health[-1] == expected, (scale, track.nis_mean[-1])


def test_a_gate_that_refuses_most_is_divergence():
    values = GOOD[:20] + [5.0] * 60
    health = healths(history(values), gate=0.999)
    assert health[19] == TRACKING
    assert DIVERGED in health[20:]
    track = fold("kf", COMPASS, Tuning.of(COMPASS).set("gate", 0.999), history(values))
    first = int(np.flatnonzero(track.health == DIVERGED)[0])
    # More than half of the window, which by then holds all that came: 20 good ones and 21 refused.
    assert np.sum(track.verdict[: first + 1] == GATED) == 21


def test_an_estimate_that_is_not_finite_is_divergence():
    # Far beyond what a tuning may be set to.
    tuning = replace(Tuning.of(COMPASS), q=np.array([1e308]))
    track = fold("kf", COMPASS, tuning, history([-3.1, -3.1, -3.1], step=1e6))
    assert track.health[-1] == DIVERGED
    assert not np.isfinite(track.std[-1, 0]) or not np.isfinite(track.mean[-1, 0])


def events_of(rng, n):
    """Times, kinds and a track of all that can happen: stretches of readings and of silence, good and bad ones, resets.

    Steps are 0 or 1 s, so that ages are whole and meet their limits exactly.
    """
    t = np.cumsum(rng.integers(0, 2, n)) * SECOND
    kind = np.full(n, TICK, np.int8)
    track = Track.allocate(n, 2, 0, 1)
    track.mean[:], track.std[:] = 0.0, 1.0
    at = 0
    while at < n:
        rows = np.arange(at, min(n, at + int(rng.integers(20, 400))))
        share = rng.choice([0.02, 0.1, 0.9])
        verdicts = rng.choice(
            [USED, GATED, FAILED, MISSING, HELD_OUT], p=rng.dirichlet([6, 1, 1, 1, 1]), size=rows.size
        )
        judged = rng.random(rows.size) < share
        track.verdict[rows[judged]] = verdicts[judged]
        kind[rows[judged]] = READING
        track.dof[rows] = rng.integers(1, 4, rows.size)
        track.nis[rows] = rng.chisquare(track.dof[rows]) * rng.choice([1.0, 2.0, 3.0, 6.0])
        at += rows.size
    kind[rng.choice(n, n // 150)] = RESET
    track.verdict[kind == RESET] = NONE
    for column in (track.mean, track.std):
        column[rng.choice(n, n // 100), rng.integers(0, 2)] = rng.choice([np.inf, np.nan])
    return t, kind, track


def by_definition(t, kind, channel, track, normal, policy):
    """Each row's age, NIS of the window, bounds and consistency, from the words of `HealthPolicy` and of `assess`."""
    judged = np.isin(track.verdict, (USED, GATED, FAILED))
    whole = np.arange(1, 3 * policy.window + 1)
    quantiles = [chi2.ppf(q, whole) for q in (0.025, 0.975)]
    resets, lost = np.flatnonzero(kind == RESET), False
    for i in range(len(t)):
        # The row that last changed the window.
        e = max([k for k in range(i, -1, -1) if judged[k] or kind[k] == RESET][:1] or [0])
        after = max(resets[resets <= e], default=-1)
        rows = [k for k in range(max(after + 1, e - MAX_ROWS_PER_READING * policy.window + 1, 0), e + 1) if judged[k]][
            -policy.window :
        ]
        used = [k for k in rows if track.verdict[k] == USED]
        total, dof = float(np.sum(track.nis[used])), int(np.sum(track.dof[used], dtype=int))
        due, mean, variance = track.dof[used] @ normal[channel[used]]
        values = [np.nan] * 3
        if used:
            # A chi-square times a factor that has this mean and variance, between those of whole degrees of freedom.
            free = max(1.0, min(2.0 * mean**2 / variance, dof))
            bounds = (mean / free * np.interp(free, whole, quantile) / len(used) for quantile in quantiles)
            values = [total / len(used), *bounds]
        refused = len(rows) - len(used)
        limit = 0.5 if lost else 1.0  # what was lost is until it is half as bad
        lost = refused > limit * policy.diverged_gated * len(rows) or total > limit * policy.diverged_nis * due
        lost &= len(rows) >= MIN_WINDOW_EVENTS
        yield (t[i] - t[e]) / SECOND, *values, DIVERGED if lost else TRACKING


@pytest.mark.parametrize("seed", range(3))
def test_the_window_is_its_definition_in_any_pieces(seed):
    """A window of 12 that may look back 240 rows, of which a quarter may be refused: of 12 exactly 3."""
    rng = np.random.default_rng(seed)
    policy = HealthPolicy(window=12, degraded_after=2.0, stale_after=6.0, diverged_nis=2.5, diverged_gated=0.25)
    t, kind, track = events_of(rng, 3000)
    # With few digits, so that their sum is exact in any order.
    channel = rng.integers(0, 3, 3000).astype(np.int32)
    normal = np.array([[1.0, 1.0, 2.0], [1.5, 1.5, 9.0], [1.0, 0.25, 0.5]])
    at = 0
    while at < len(t):
        end = min(len(t), at + int(rng.choice([1, 7, 40, 500])))
        assess(at, end, t, kind, channel, track, normal.ravel(), policy, chi_square_bounds(3 * policy.window))
        at = end
    age, mean, low, high, consistency = map(
        np.array, zip(*by_definition(t, kind, channel, track, normal, policy), strict=True)
    )
    assert set(consistency) == {TRACKING, DIVERGED}
    np.testing.assert_array_equal(track.age, age)
    np.testing.assert_array_equal(track.consistency, consistency)
    for column, expected in ((track.nis_mean, mean), (track.nis_low, low), (track.nis_high, high)):
        np.testing.assert_allclose(column, expected, rtol=1e-12)  # sums of at most 12 numbers, in another order
