"""Events that bring their own variance: as if they were of a sensor that is tuned to it, in every filter."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import registry
from estimators.errors import EstimatorError
from estimators.fold import Fold, fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Row, Sensor
from estimators.models import MODELS
from estimators.registry import ESTIMATORS, unfit
from estimators.tuning import Tuning
from tests.estimators.linear_models import random_linear
from tests.estimators.test_fold import in_python
from tests.support import SECOND, as_log, assert_same, folded, measured

PLAIN = random_linear(np.random.default_rng(5), 3, 2).model
COARSE, FINE = (4.0, 9.0), (0.25, 0.04)


def two_of(model):
    """The model with its second sensor, of two rows, under two names that differ in their variances."""
    h = model.sensors[1].h

    def sensor(name, variances):
        return Sensor(name, tuple(Row(f"r{k}", "m", variance) for k, variance in enumerate(variances)), h=h)

    return replace(model, sensors=(sensor("coarse", COARSE), sensor("fine", FINE)))


MODEL = two_of(PLAIN)
NAMES = [name for name, entry in ESTIMATORS.items() if unfit(entry, MODEL) is None and not entry.fixed_r]
SMALL = {"particles": 40.0, "members": 9.0}


def logs(rng, events=60):
    """The same readings twice: as the coarse sensor's with variances of their own, and as the fine sensor's."""
    own, fine = [], []
    for k in range(events):
        t, y = (k + 1) * SECOND // 10, rng.normal(0, 1, 2)
        y[rng.random(2) < 0.2] = np.nan
        kind = rng.integers(0, 3)
        if kind == 0:
            both = Events.one(t, t, READING, 0, y, MODEL.width)
            own.append(both)
            fine.append(both)
            continue
        own.append(Events.one(t, t, READING, 0, [*y, *[np.nan] * (MODEL.width - 2), *FINE], MODEL.width + 2))
        fine.append(Events.one(t, t, READING, 1, y, MODEL.width))
    made = []
    for batch in (own, fine):
        log = Log.of(MODEL)
        for event in batch:
            log.extend(event)
        made.append(log)
    return made


def options(name):
    return {option.name: SMALL[option.name] for option in ESTIMATORS[name].options if option.name in SMALL}


JUDGED = ("alarms", "flags", "health")


@pytest.mark.parametrize("name", [*NAMES, "ekf-python"])
def test_the_same_bits_as_a_sensor_tuned_to_it(name, monkeypatch):
    monkeypatch.setitem(registry.ESTIMATORS, "ekf-python", in_python("ekf"))
    own, fine = logs(np.random.default_rng(2))
    assert own.has_variances and not fine.has_variances
    tuning = Tuning.of(MODEL).with_options(options(name))
    track, expected = (fold(name, MODEL, tuning, log) for log in (own, fine))
    # What is judged of them, with how many sensors there are, is not the filter's.
    assert_same(track._replace(**dict.fromkeys(JUDGED)), expected._replace(**dict.fromkeys(JUDGED)))
    # And it matters: with the coarse variances alone the estimate is another.
    plain = as_log(own.events._replace(value=own.events.value[:, : MODEL.width]))
    assert not np.allclose(fold(name, MODEL, tuning, plain).mean, expected.mean, rtol=1e-3)


@pytest.mark.parametrize("name", ["kf", "pf", "filterpy-kf"])
def test_the_tuned_variances_are_back_afterwards(name):
    """Whatever the pieces, and for the other fold that has the same tuning."""
    own, _ = logs(np.random.default_rng(3))
    tuning = Tuning.of(MODEL).with_options(options(name))
    before = tuning.r.copy()
    whole = fold(name, MODEL, tuning, own)
    growing = Fold(name, MODEL, tuning, own)
    while growing.advance(1):
        pass
    assert_same(growing.track, whole)
    np.testing.assert_array_equal(tuning.r, before)
    np.testing.assert_array_equal(growing.machine.held["r"], before)


def test_a_row_without_its_own_keeps_the_tuned_one():
    """NaN beside a number: R = diag(own, tuned), by the equations of the Kalman filter."""
    log = Log.of(MODEL, start=1.0)
    log.add("coarse", 1.0, [[0.5, -0.3]], variance=[[0.01, np.nan]])
    track = folded("kf", MODEL, log).track
    matrices = random_linear(np.random.default_rng(5), 3, 2)
    P, H, R = np.diag(matrices.std**2), matrices.H[1], np.diag([0.01, COARSE[1]])
    S = H @ P @ H.T + R
    nu = np.array([0.5, -0.3]) - H @ matrices.mean - matrices.D[1] @ matrices.u
    np.testing.assert_allclose(track.mean[0], matrices.mean + P @ H.T @ np.linalg.solve(S, nu), rtol=1e-12)
    np.testing.assert_allclose(track.nis[0], nu @ np.linalg.solve(S, nu), rtol=1e-12)


def test_memory_only_where_it_is_used():
    log = measured(MODEL, "coarse", [1.0, 2.0], np.zeros((2, 2)), capacity=100)
    assert log.value.shape == (100, MODEL.width)
    log.add("coarse", 1.5, np.zeros((1, 2)), variance=2.0)
    assert log.value.shape[1] == MODEL.width + MODEL.ny and log.n == 3
    own = log.events.value[:, MODEL.width : MODEL.width + 2]
    np.testing.assert_array_equal(own, [[np.nan, np.nan], [2.0, 2.0], [np.nan, np.nan]])
    twin = log.copy()
    log.drop_front(1)
    np.testing.assert_array_equal(twin.events.select(slice(1, None)).value, log.events.value)


def test_filters_that_hold_on_to_one_r_say_so():
    log = Log.of(PLAIN)
    log.add("second", 1.0, [[0.0, 0.0]], variance=1.0)
    with pytest.raises(EstimatorError, match="adapt learns one R of each sensor; set adapt to off or Q"):
        fold("ekf", PLAIN, Tuning.of(PLAIN).with_options({"adapt": 1.0}), log)
    folded("ekf", PLAIN, log, options={"adapt": 2.0})
    winding = MODELS["motor_winding"]
    log = Log.of(winding)
    growing = Fold("kf-steady", winding, Tuning.of(winding), log)
    log.add("winding", 1.0, 40.0, variance=4.0)
    with pytest.raises(EstimatorError, match="kf-steady: readings bring their own variance.*use kf"):
        growing.advance()
