"""Attribution: what moved the estimate, against the gains and innovations of NumPy's filter, and for every filter."""

import numpy as np
import pytest

from estimators.attribution import LARGEST, attribution
from estimators.errors import EstimatorError
from estimators.events.maintenance import maintained
from estimators.fold import Fold
from estimators.log import INPUT, READING, TICK, Events, Log
from estimators.registry import ESTIMATORS, unfit
from estimators.tuning import Tuning
from tests.estimators.linear_models import random_linear, random_log
from tests.support import SECOND, assert_same

SINCE, UNTIL = 6 * SECOND, 12 * SECOND


def shares_of(matrices, log):
    """Changes by the model, each input and each sensor in the span, by the equations of the Kalman filter."""
    n, u, default = matrices.mean.size, matrices.u.copy(), matrices.u
    m, P = matrices.mean.copy(), np.diag(matrices.std**2)
    clock = log.t[0]
    found = np.zeros((1 + u.size + len(matrices.H), n))
    for k in range(log.n):
        if log.t[k] > UNTIL:
            break
        inside = log.t[k] > SINCE
        dt = (log.t[k] - clock) * 1e-9
        clock = log.t[k]
        F = np.eye(n) + dt * matrices.A
        P = F @ P @ F.T + matrices.q * dt * matrices.W
        if inside:
            found[0] += dt * (matrices.A @ m + matrices.B @ default)
            found[1 : 1 + u.size] += dt * (matrices.B * (u - default)).T
        m = F @ m + dt * matrices.B @ u
        value = log.events.value[k]
        if log.kind[k] == INPUT:
            given = value[: u.size]
            u = np.where(np.isfinite(given), given, u)
            continue
        s = log.events.channel[k]
        y = value[: matrices.H[s].shape[0]]
        seen = np.isfinite(y)
        H, D, R = matrices.H[s][seen], matrices.D[s][seen], np.diag(matrices.R[s][seen])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        change = K @ (y[seen] - H @ m - D @ u)
        m, P = m + change, P - K @ H @ P
        if inside:
            found[1 + u.size + s] += change
    return found


def test_gains_and_innovations_of_the_kalman_filter():
    rng = np.random.default_rng(2)
    matrices = random_linear(rng, 3, 2)
    log = random_log(rng, matrices, 200)
    fold = Fold("kf", matrices.model, Tuning.of(matrices.model), log)
    found = attribution(fold, SINCE, UNTIL)
    rows = np.vstack((found.model, found.inputs, found.sensors))
    np.testing.assert_allclose(rows, shares_of(matrices, log), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.restarts, 0.0)
    inside = (log.events.t > SINCE) & (log.events.t <= UNTIL) & (log.events.kind == READING)
    np.testing.assert_array_equal(found.readings, np.bincount(log.events.channel[inside], minlength=3))


RUNNING = [
    name
    for name, entry in ESTIMATORS.items()
    if unfit(entry, random_linear(np.random.default_rng(0), 3, 2).model) is None
]


@pytest.mark.parametrize("estimator", [*RUNNING, "kf with maintenance"])
def test_the_sum_is_the_change_and_the_fold_is_as_it_would_have_been(estimator):
    estimator, maintenance, _ = estimator.partition(" with maintenance")
    rng = np.random.default_rng(3)
    matrices = random_linear(rng, 3, 2)
    log = random_log(rng, matrices, 120)
    width = matrices.model.width
    log.extend(Events.one(8 * SECOND, 8 * SECOND, TICK, 0, np.full(width, np.nan), width))
    log.extend(maintained(8 * SECOND, 8 * SECOND, (0,) if maintenance else (), width))
    tuning = Tuning.of(matrices.model)
    whole, fold = (Fold(estimator, matrices.model, tuning, log) for _ in range(2))
    whole.advance()
    events = [column.copy() for column in log.events]
    found = attribution(fold, SINCE, UNTIL)
    fold.advance()
    assert_same(fold.track, whole.track)
    assert_same(log.events, events)
    before, after = (int(np.searchsorted(log.events.t, time, side="right")) - 1 for time in (SINCE, UNTIL))
    np.testing.assert_array_equal(found.before, whole.track.mean[before])
    np.testing.assert_array_equal(found.after, whole.track.mean[after])
    total = found.model + found.inputs.sum(axis=0) + found.sensors.sum(axis=0) + found.restarts
    np.testing.assert_allclose(total, found.after - found.before, rtol=0, atol=1e-9)


def test_the_largest_corrections_are_those_of_the_track():
    rng = np.random.default_rng(4)
    matrices = random_linear(rng, 2, 1)
    log = random_log(rng, matrices, 100)
    found = attribution(Fold("kf", matrices.model, Tuning.of(matrices.model), log), SINCE, UNTIL)
    for j, corrections in enumerate(found.largest):
        sizes = [abs(item.change) for item in corrections]
        assert len(sizes) == LARGEST and sizes == sorted(sizes, reverse=True)
        assert sum(item.change for item in corrections if item.sensor == 0) == pytest.approx(
            found.sensors[0][j], abs=sum(sizes[-1] for _ in range(found.readings[0]))
        )


def test_a_span_without_events_or_with_too_many_is_refused(monkeypatch):
    matrices = random_linear(np.random.default_rng(5), 2, 1)
    log = random_log(np.random.default_rng(5), matrices, 100)
    fold = Fold("kf", matrices.model, Tuning.of(matrices.model), log)
    with pytest.raises(EstimatorError, match="no event in the span"):
        attribution(fold, 10**15, 2 * 10**15)
    monkeypatch.setattr("estimators.attribution.MAX_EVENTS", 10)
    with pytest.raises(EstimatorError, match="events; choose one with at most 10"):
        attribution(fold, 0, 10**15)
    with pytest.raises(EstimatorError, match="no event in the span"):
        attribution(Fold("kf", matrices.model, Tuning.of(matrices.model), Log(matrices.model.width)), 0, 1)
