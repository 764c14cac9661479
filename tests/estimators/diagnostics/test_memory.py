"""Corrections over a state's own memory are those since a forecast, and tell of a steady error."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.detectors import IMPOSSIBLE_AT, memory_flag
from estimators.diagnostics.health import HealthPolicy
from estimators.diagnostics.memory import fresh_memory, level_of, memory_of
from estimators.diagnostics.references import HALF_WIDTH, SUSPICIONS, own_grades, state_grades, state_health
from estimators.fleet.fleet import Fleet
from estimators.fold import Fold
from estimators.log import INPUT, READING, RESET, Log
from estimators.model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from estimators.numerics.jit import plain
from estimators.numerics.workspace import size_of, view
from estimators.smoothing.smooth import smooth
from estimators.track import SUSPECT
from estimators.tuning import Tuning
from tests.support import folded, log_of


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * 1e-3 * u[0]
    out[1] = x[1] + dt * (u[0] - x[1]) / 20.0


def h(x, u, p, out):
    out[0] = x[0] + 0.05 * x[1]


CELL = StateSpaceModel(
    name="cell",
    title="charge and polarisation",
    states=(State("charge", "1", 0.5, 0.05), State("polarisation", "V", 0.0, 0.1)),
    inputs=(Input("current", "A"),),
    noises=(Noise("charge", "1/s", 1e-8), Noise("polarisation", "V²/s", 1e-4)),
    sensors=(Sensor("voltage", (Row("voltage", "V", 4e-4),), h=h),),
    f=f,
    linear=True,
)
QUIET = HealthPolicy(false_alarm_every=1e12)
VOLTAGE = CELL.sensors[0].rows[0].variance
F, Q, H = np.diag([1.0, 0.95]), np.diag([1e-8, 1e-4]), np.array([1.0, 0.05])


def cell(scale, n, seed=0):
    """A log of a cell whose current is known with a wrong scale, and its true states (n, 2)."""
    rng = np.random.default_rng(seed)
    current = 0.3 * np.repeat(rng.standard_normal(n // 50 + 1), 50)[:n]
    x, states, rows = rng.normal([0.5, 0.0], [0.05, 0.1]), [], []
    for i in range(n):
        if i:
            f(x.copy(), current[i - 1 : i], (), 1.0, x)
            x += rng.normal(0.0, [1e-4, 1e-2])
        states.append(x.copy())
        rows += [(i, INPUT, scale * current[i]), (i, READING, x[0] + 0.05 * x[1] + rng.normal(0.0, VOLTAGE**0.5))]
    return log_of(CELL.width, *rows), np.array(states)


def by_forecasts(log, first, end):
    """z, rho and variance of both states, from a forecast without measurements `first` to `end` of a dense filter."""
    u, y = log.value[0 : log.n : 2, 0], log.value[1 : log.n : 2, 0]
    x, P, start = np.array([0.5, 0.0]), np.diag([0.05**2, 0.1**2]), None
    for k in range(end):
        for own in (x, start[0]) if start else (x,):
            if k:
                own[:] = F @ own + np.array([1e-3, 0.05]) * u[k - 1]
        if k:
            P = F @ P @ F.T + Q
            start = start and (start[0], F @ start[1] @ F.T + Q)
        if k == first:
            start = x.copy(), P
        K = P @ H / (H @ P @ H + VOLTAGE)
        x, P = x + K * (y[k] - H @ x), P - np.outer(K, H @ P)
    spread = np.diag(start[1] - P)
    return (x - start[0]) / np.sqrt(spread), np.diag(P) / np.diag(start[1]), np.diag(P)


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf", "sr-kf", "sr-ukf"])
def test_corrections_are_those_since_a_forecast(name):
    log, _ = cell(1.3, 64)
    memory = folded(name, CELL, log).evidence[-fresh_memory(CELL).size :]
    first = size_of(memory_of, 2)
    for k, times in enumerate((((0, 32), (16, 48), (32, 64)), ((0, 64),))):
        W = excess = np.zeros(2)
        for time in times:
            z, rho, _ = by_forecasts(log, *time)
            # Half of log Λ of the variance 2.5 against 1, as the times overlap by half.
            told = (rho > 0.2) & (rho < 0.9)
            gained = np.where(told, 0.15 * np.clip(z, -6.0, 6.0) ** 2 - 0.25 * np.log(2.5), 0.0)
            W = np.maximum(W + gained, 0.0)
            excess = np.where(told, 0.75 * excess + 0.25 * (np.minimum(z**2, 36.0) - 1.0), excess)
        level, own = plain(level_of)(0, 2), memory[first + k * size_of(level_of, 2) :]
        found = view(level.W, own), view(level.rho, own), view(level.excess, own)
        np.testing.assert_allclose(found, (W, rho, excess), rtol=1e-6, err_msg=f"{time}")


def told(scale, model=CELL, seed=0):
    """Error of the charge in its σ, and whether its state and the twin are suspect, by measurement; the fold."""
    log, true = cell(scale, 4000, seed)
    fold = folded("kf", model, log, policy=QUIET)
    track = fold.track.select(slice(1, None, 2))
    error = np.abs(track.mean[:, 0] - true[:, 0]) / track.std[:, 0]
    return error, state_health(track, 0) == SUSPECT, track.health == SUSPECT, fold


@pytest.mark.parametrize("seed", range(4))
def test_a_model_that_is_right_is_never_suspect(seed):
    error, own, twin, _ = told(1.0, seed=seed)
    assert (error <= HALF_WIDTH).mean() > 0.85 and not own.any() and not twin.any()


def test_a_steady_error_that_no_sensor_shows_is_told_of_the_state_that_it_moves():
    error, own, twin, fold = told(0.9)
    factor = fold.track.factor[1::2]
    assert not fold.track.alarms.any(), "single innovations show nothing"
    assert (~own & (error > HALF_WIDTH)).mean() <= 0.05 and own.mean() > 0.5
    assert np.array_equal(factor[:, 0] > 1.0, own) and np.all(factor[:, 1] == 1.0)
    assert (error <= HALF_WIDTH)[own].mean() < 0.9 and np.all((error <= HALF_WIDTH * factor[:, 0])[own])
    assert np.all(smooth(fold).instead_of(fold.track).factor == 1.0), "they are of the filter's corrections"
    assert not (fold.track.flags & memory_flag(1)).any() and np.array_equal(own, twin)
    found = own_grades(CELL, fold.track, fold.u)
    assert found == {"charge": ("suspect", "corrected by more than its band allows, over its memory or from its prior")}
    assert state_grades(CELL, found, SUSPECT, "another")["charge"] == found["charge"]
    *_, unwatched, _ = told(0.9, replace(CELL, states=(replace(CELL.states[0], watched=False), CELL.states[1])))
    assert not unwatched.any()


@pytest.mark.parametrize("gate", [None, 0.999])
def test_a_prior_that_the_first_measurement_contradicts_is_told_of_what_it_still_determines(gate):
    """While 6 of its deviations, forecast and reduced by the measurements, are more than one of the state's own.

    The polarisation has a correlation of 0.09 with the first measurement, so its prior is not told to be wrong.
    """
    log, _ = cell(1.0, 400)
    far = replace(CELL, states=(replace(CELL.states[0], mean=1.2), CELL.states[1]))
    track = folded("kf", far, log, policy=QUIET, tuning=replace(Tuning.of(far), gate=gate)).track
    own = (track.flags[3::2, None] & [memory_flag(0), memory_flag(1)]) != 0
    rho, P = np.array([by_forecasts(log, 0, end)[1:] for end in range(2, 401)]).swapaxes(0, 1)
    error = 6.0 * rho * np.column_stack((np.full(399, 0.05), np.zeros(399)))
    # A gate refuses all measurements, which is another alarm.
    np.testing.assert_array_equal(own, (error > np.sqrt(P)) & (gate is None))


@pytest.mark.parametrize(("offset", "until"), [(0.3, 600), (0.9, 3)])
def test_an_impossible_estimate_is_told_until_measurements_have_corrected_it(offset, until):
    """While its band and that of a forecast from its limit do not meet, though the charge has sunk."""
    limited = replace(CELL, states=(replace(CELL.states[0], mean=0.95, limits=(0.0, 1.0)), CELL.states[1]))
    rng, rows, n = np.random.default_rng(3), [], 600
    for i in range(n):
        y = 0.95 - 1e-3 * i + rng.normal(0.0, 0.02) + (offset if i < until else 0.0)
        rows += [(i, INPUT, -1.0), (i, READING, y - 0.05 * (1.0 - 0.95**i))]
    log = log_of(CELL.width, *rows)
    fold = folded("kf", limited, log, policy=QUIET)
    track, y = fold.track.select(slice(1, None, 2)), log.value[1::2, 0]
    x, P, start, told = np.array([0.95, 0.0]), np.diag([0.05**2, 0.1**2]), None, []
    for i in range(n):
        if i:
            x, P = F @ x - [1e-3, 0.05], F @ P @ F.T + Q
            start = start and (F @ start[0] - [1e-3, 0.05], F @ start[1] @ F.T + Q)
        K = P @ H / (H @ P @ H + VOLTAGE)
        x, P = x + K * (y[i] - H @ x), P - np.outer(K, H @ P)
        if x[0] - 1.0 > max(HALF_WIDTH * P[0, 0] ** 0.5, x[0] - start[0][0] if start else 0.0):
            start = np.array([1.0, x[1]]), P * [[0.0, 0.0], [0.0, 1.0]]
        if start and x[0] - start[0][0] <= HALF_WIDTH * (P[0, 0] ** 0.5 + start[1][0, 0] ** 0.5):
            start = None
        told.append(start is not None)
    found = track.flags & memory_flag(0, IMPOSSIBLE_AT) != 0
    np.testing.assert_array_equal(found, told)
    reasons = [text for _, text in own_grades(limited, fold.track, fold.u).values()]
    assert found[0] and (SUSPICIONS[IMPOSSIBLE_AT] in reasons) == (until == n) and track.mean[-1, 0] < 1.0


def test_a_reset_begins_again():
    log, _ = cell(0.9, 4000)
    log.extend(log_of(CELL.width, (4000, RESET, 0.0)).events)
    flags = folded("kf", CELL, log).track.flags
    assert flags[-2] & memory_flag(0) and not flags[-1]


def test_a_fold_from_an_asset_of_a_fleet_keeps_the_state_of_its_detectors():
    fleet = Fleet("kf", CELL, assets=1)
    fleet.add("voltage", np.zeros(9, int), np.arange(9.0), np.linspace(0.4, 0.6, 9))
    fleet.advance()
    base = fleet.base(0)
    evidence = Fold("kf", CELL, Tuning.of(CELL), Log.of(CELL), base=base).evidence
    np.testing.assert_array_equal(evidence, np.append(base.evidence, fresh_memory(CELL)))
