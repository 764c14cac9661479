"""Maintenance: the states that are named are as unknown as at the start, whatever the filter, the pieces, the order."""

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.events.maintenance import maintained, model_versions
from estimators.fold import fold
from estimators.log import INPUT, MAINTENANCE, READING, TICK, Events, Log, model_version_at
from estimators.models import MODELS
from estimators.tuning import Tuning
from tests.support import SECOND, as_log, folded

MODEL = MODELS["motor_winding"]
PAIR = np.array([[0, 1]])
HALF = SECOND // 2


def stream(n=300, at=(100, 200), states=(1,), seed=0):
    """Readings of the winding at every second, and maintenance half a second after those numbered `at`."""
    y = 40.0 + np.cumsum(np.random.default_rng(seed).normal(size=n))
    t = np.arange(1, n + 1) * SECOND
    readings = Events.alike(READING, t, y)
    changes = [maintained((k + 1) * SECOND + HALF, 0, states, MODEL.width) for k in at]
    return Events.concat([readings, *changes], MODEL.width)


def log_of(events):
    return as_log(events)


def test_the_kalman_filter_is_the_textbooks_with_the_covariance_edited():
    """The recursion written out, with F and Q of the model measured at its own functions."""
    log = log_of(stream(states=(1,)))
    tuning = Tuning.of(MODEL)
    track = fold("kf", MODEL, tuning, log, pairs=PAIR)
    made = compile_model(MODEL)
    n, u = MODEL.nx, MODEL.default_inputs
    H = np.zeros((1, n))
    H[0, 0] = 1.0
    x, P, clock = MODEL.prior_mean.copy(), np.diag(MODEL.prior_std**2), None
    for k in range(log.n):
        dt = 0.0 if clock is None else (log.t[k] - clock) * 1e-9
        steps = max(1, int(np.ceil(dt / MODEL.max_step))) if dt else 0
        for _ in range(steps):
            zero, F = np.empty(n), np.empty((n, n))
            made.f(np.zeros(n), u, tuning.p, dt / steps, zero)
            for j in range(n):
                column = np.empty(n)
                made.f(np.eye(n)[j], u, tuning.p, dt / steps, column)
                F[:, j] = column - zero
            Q = np.zeros((n, n))
            made.Q(x, u, tuning.p, tuning.q, dt / steps, Q)
            x, P = F @ x + zero, F @ P @ F.T + Q
        clock = log.t[k]
        if log.kind[k] == MAINTENANCE:
            j = log.channel[k]
            P[j, :] = P[:, j] = 0.0
            P[j, j] = MODEL.prior_std[j] ** 2
        else:
            S = H @ P @ H.T + tuning.r[0]
            K = P @ H.T / S
            x = x + K[:, 0] * (log.value[k, 0] - x[0])
            P = P - K @ H @ P
        # Both are rounded at each of some hundreds of steps.
        np.testing.assert_allclose(track.mean[k], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(track.std[k], np.sqrt(np.diag(P)), rtol=1e-8)
        np.testing.assert_allclose(track.cross[k], P[0, 1], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("estimator", ["kf", "ekf", "iekf", "ukf", "ckf", "sr-kf", "sr-ekf", "sr-ukf"])
def test_mean_stays_and_the_variance_is_the_priors(estimator):
    log = log_of(Events.concat([stream(), query()], MODEL.width))
    track = folded(estimator, MODEL, log, pairs=PAIR).track
    rows = np.flatnonzero(log.events.kind == MAINTENANCE)
    assert rows.size == 2
    for row in rows:
        np.testing.assert_allclose(track.std[row, 1], MODEL.prior_std[1], rtol=1e-9)
        assert abs(track.cross[row, 0]) < 1e-9
    # A query at that time, which comes before it, tells what it was before.
    before = rows[0] - 1
    assert log.kind[before] == TICK
    np.testing.assert_allclose(track.mean[rows[0]], track.mean[before], rtol=1e-9)
    np.testing.assert_allclose(track.std[rows[0], 0], track.std[before, 0], rtol=1e-9)
    assert track.std[before, 1] < 0.9 * track.std[rows[0], 1]


def query():
    return Events.one(101 * SECOND + HALF, 0, TICK, 0, [], MODEL.width)


@pytest.mark.parametrize(("estimator", "count"), [("pf", 4000), ("enkf", 1000), ("etkf", 1000)])
def test_members_are_drawn_from_the_same(estimator, count):
    tuning = Tuning.of(MODEL).with_options({"particles" if estimator == "pf" else "members": count})
    log = log_of(stream(150, at=(100,)))
    track = fold(estimator, MODEL, tuning, log, pairs=PAIR)
    (row,) = np.flatnonzero(log.events.kind == MAINTENANCE)
    # The deviation of a sample's standard deviation is 1/sqrt(2 n) of it; four of them.
    np.testing.assert_allclose(track.std[row, 1], MODEL.prior_std[1], rtol=4 / np.sqrt(2 * count))


def test_versions_count_times_not_states():
    log = log_of(stream(states=(0, 1)))
    versions = model_versions(log.events)
    t = log.events.t
    expected = 1 + (t >= 101 * SECOND + HALF) + (t >= 201 * SECOND + HALF)
    np.testing.assert_array_equal(versions, expected)
    assert [model_version_at(log, s * SECOND) for s in (0, 101, 102, 250)] == [1, 1, 2, 3]


@pytest.mark.parametrize("count", [50, 100, 101, 102, 103, 104, 150, 203, 204, 205, 303])
def test_versions_go_on_after_the_oldest_events_are_dropped(count):
    """Also where a maintenance of two states is cut in half."""
    log = log_of(stream(states=(0, 1)))
    t, versions = log.events.t.copy(), model_versions(log.events)
    log.drop_front(count)
    after = model_versions(log.events, log.version)
    # The half that stays begins the version that its first half had begun.
    np.testing.assert_array_equal(after, versions[count:])
    assert model_version_at(log, int(t[-1])) == 3


def test_a_base_knows_its_version():
    log = log_of(stream(3000, at=(100, 200)))
    made = folded("kf", MODEL, log)
    at, base = made.base_at(2048)
    assert at == 2048 and base.version == 3 and made.base_at(10)[1].version == 1


def test_a_log_that_resumes_from_a_base_counts_versions_on():
    """`Log.resume` restores index, floor and version, so its rows carry the numbers of the log it continues."""
    log = log_of(stream(3000, at=(100, 200, 2500)))
    made = folded("kf", MODEL, log)
    at, base = made.base_at(2048)
    part = Log.resume(MODEL, base, log.events.select(slice(at, None)))
    np.testing.assert_array_equal(model_versions(part.events, part.version), model_versions(log.events)[at:])
    again = folded("kf", MODEL, part, base=base)
    assert (again.base_here().version, again.base_here().first) == (4, log.n)
    np.testing.assert_array_equal(again.track.mean, made.track.mean[at:])
    _, stale = part.extend(log.events.select(slice(0, 1)))
    assert stale == 1, "an event before the base cannot change what the base already contains"


def test_before_anything_was_said_it_starts_at_the_prior():
    log = log_of(Events.concat([maintained(0, 0, [0], MODEL.width), stream(10, at=())], MODEL.width))
    track = folded("kf", MODEL, log).track
    np.testing.assert_allclose(track.mean[0], MODEL.prior_mean)
    np.testing.assert_allclose(track.std[0], MODEL.prior_std)
    assert INPUT not in log.events.kind
