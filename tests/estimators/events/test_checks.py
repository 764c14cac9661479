"""Checks of the log on entry: what no model has a place for is refused, and the log stays as it was."""

import json
import subprocess
import sys

import numpy as np
import pytest

from estimators.errors import EstimatorError, EventError
from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events, Log
from estimators.model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.snapshots import Base
from estimators.tuning import Tuning
from tests import ROOT
from tests.cases import cases
from tests.models import first_state, first_states
from tests.support import SECOND


def still(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = x[1] + dt * u[0]


TWO = StateSpaceModel(
    name="two",
    title="two states, two sensors",
    states=(State("a", "m", 0.0, 1.0), State("b", "m", 0.0, 1.0)),
    noises=(Noise("a", "m²/s", 0.1), Noise("b", "m²/s", 0.1)),
    inputs=(Input("push", "m/s"),),
    sensors=(
        Sensor("one", (Row("one", "m", 1.0),), h=first_state),
        Sensor("pair", (Row("a", "m", 1.0), Row("b", "m", 2.0)), h=first_states),
    ),
    f=still,
)
FINE = Events.one(SECOND, SECOND, READING, 1, [0.5, 0.25], TWO.width)


def event(kind, channel, values, width=TWO.width, t=SECOND):
    return Events.one(t, t, kind, channel, values, width)


WRONG = {
    "a sensor that is not there": (event(READING, 2, 1.0), "channel is 2; two has 2 sensor"),
    "a sensor far away": (event(READING, 10**6, 1.0), "channel is 1000000"),
    "a negative sensor": (event(READING, -1, 1.0), "channel is -1"),
    "a state that is not there": (event(TRUTH, 2, 1.0), "channel is 2; two has 2 states"),
    "a channel of an input": (event(INPUT, 1, 1.0), "channel is 1; for this kind it must be 0"),
    "a kind that is not there": (event(77, 0, 1.0), "kind is 77"),
    "a negative kind": (event(-1, 0, 1.0), "kind is -1"),
    "rows beyond the sensor's": (event(READING, 0, [1.0, 2.0]), "one has 1 row"),
    "inputs beyond the model's": (event(INPUT, 0, [1.0, 2.0]), "two has 1 input"),
    "states beyond the model's": (event(TRUTH, 1, [1.0, 2.0]), "1 state.s. from there on"),
    "more columns than the log": (event(INPUT, 0, [np.nan, np.nan, 3.0], 3), "3 values; the log has 2 column"),
    "a time beyond any clock": (event(READING, 0, 1.0, t=2**62), "146 years"),
    "a time before any clock": (event(READING, 0, 1.0, t=-(2**63)), "146 years"),
    "a variance of a row that is not there": (event(READING, 0, [1.0, np.nan, np.nan, 2.0], 4), "variance to row 1"),
    "a variance of zero": (event(READING, 0, [1.0, np.nan, 0.0], 3), "variance is 0"),
    "a negative variance": (event(READING, 0, [1.0, np.nan, -4.0], 3), "variance is -4"),
    "an infinite variance": (event(READING, 0, [1.0, np.nan, np.inf], 3), "variance is inf"),
    "float times": (FINE._replace(t=np.array([1.5])), "t holds float64"),
    "float channels": (FINE._replace(channel=np.array([1.0])), "channel holds float64"),
    "a channel that int32 would wrap": (FINE._replace(channel=np.array([2**32 + 1])), "channel holds 4294967297"),
    "a kind that int8 would wrap": (FINE._replace(kind=np.array([256])), "kind holds 256"),
    "columns of other lengths": (FINE._replace(channel=np.zeros(2, np.int32)), "channel has shape"),
    "values of another length": (FINE._replace(value=np.zeros((2, 2))), "value has shape"),
    "values that are words": (FINE._replace(value=np.array([["a", "b"]])), "value has shape"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused_and_the_log_stays(name):
    batch, text = WRONG[name]
    log = Log.of(TWO)
    log.extend(FINE)
    with pytest.raises(EventError, match=text):
        log.extend(batch)
    assert log.n == 1 and not log.has_variances
    np.testing.assert_array_equal(log.events.value, FINE.value)


@pytest.mark.parametrize("name", [name for name, (batch, _) in WRONG.items() if batch.value.shape[1] <= TWO.width])
@pytest.mark.parametrize("grown", [False, True])
def test_a_log_of_no_model_is_checked_where_it_meets_one(name, grown):
    """Refused by the log, by the fold that is made over it, or by one that follows it: nothing else reads it."""
    batch, text = WRONG[name]
    log = Log(TWO.width)
    growing = Fold("ekf", TWO, Tuning.of(TWO), log) if grown else None
    with pytest.raises(EventError, match=text.split(";")[0]):
        log.extend(batch)
        if growing is None:
            Fold("ekf", TWO, Tuning.of(TWO), log)
        else:
            growing.advance()
    if growing is not None:
        assert growing.n == 0


def test_the_first_wrong_event_is_named_and_none_is_taken():
    log = Log.of(TWO)
    batch = Events.concat([FINE, event(READING, 1, 3.0), event(READING, 9, 1.0, t=5 * SECOND), FINE], TWO.width)
    with pytest.raises(EventError, match="event 3 of 4 .reading at 5 s.: channel is 9"):
        log.extend(batch)
    assert log.n == 0


def test_what_fits_passes():
    log = Log.of(TWO)
    fits = [
        event(INPUT, 0, 1.0),
        event(READING, 0, 1.0),
        event(READING, 1, [1.0, 2.0]),
        event(TRUTH, 0, [1.0, 2.0]),
        event(TRUTH, 1, 2.0),
        event(TICK, 0, [5.0, 6.0]),
        event(RESET, 0, ()),
    ]
    log.extend(Events.concat(fits, TWO.width))
    assert log.n == len(fits)
    assert log.events.kind.tolist() == [INPUT, READING, READING, TRUTH, TRUTH, TICK, RESET]


def test_integers_of_other_types_are_taken():
    columns = FINE._replace(
        kind=FINE.kind.astype(np.int64), channel=FINE.channel.astype(np.uint8), value=FINE.value.T.T
    )
    frozen = Events(*(column.copy() for column in columns))
    for column in frozen:
        column.flags.writeable = False
    log = Log.of(TWO)
    log.extend(frozen)
    np.testing.assert_array_equal(log.events.channel, [1])


def test_infinite_values_are_missing():
    """As NaN is: the same bits, and a likelihood of the user's own never sees them."""
    log, other = Log.of(TWO), Log.of(TWO)
    log.extend(event(READING, 1, [np.inf, 2.0]))
    other.extend(event(READING, 1, [np.nan, 2.0]))
    np.testing.assert_array_equal(log.events.value, other.events.value)


@pytest.mark.parametrize("argument", ["t", "arrival", "kind", "channel"])
def test_one_takes_integers_only(argument):
    """1.5 s given as a float became 0 ns, and the reading stood at the wrong time without a word."""
    given = {"t": 1, "arrival": 1, "kind": READING, "channel": 0, argument: 1.5}
    with pytest.raises(EventError, match=f"{argument} is 1.5; it must be"):
        Events.one(**given, values=1.0, width=2)
    given[argument] = np.int32(1)
    assert len(Events.one(**given, values=1.0, width=2)) == 1
    with pytest.raises(EventError, match="values are 3; they must be 2 at most"):
        Events.one(0, 0, READING, 0, [1.0, 2.0, 3.0], 2)


def test_a_log_narrower_than_the_model_is_refused():
    """Its readings would go on into the next event's numbers."""
    model = MODELS["lorenz63"]
    log = Log(1)
    log.extend(Events.one(0, 0, READING, 0, 1.0, 1))
    with pytest.raises(EstimatorError, match="the log has 1 value column.s.; an event of lorenz63 needs 3"):
        Fold("ekf", model, Tuning.of(model), log)


def test_a_log_of_another_model_is_checked_against_the_fold_s():
    log = Log.of(TWO)
    log.extend(event(READING, 1, [1.0, 2.0]))
    with pytest.raises(EventError, match="channel is 1; motor_winding has 1 sensor"):
        fold("ekf", MODELS["motor_winding"], Tuning.of(MODELS["motor_winding"]), log)


@cases(__file__, "no_pairs.csv")
def test_pairs_of_states_that_are_not_there(pairs, text):
    with pytest.raises(EstimatorError, match=text):
        Fold("ekf", TWO, Tuning.of(TWO), Log.of(TWO), pairs=np.array(json.loads(pairs)))


def test_a_tuning_of_another_model():
    model = MODELS["lorenz63"]
    with pytest.raises(EstimatorError, match="tuning: q has shape .2,.; lorenz63 has 3 noises"):
        Fold("ekf", model, Tuning.of(TWO), Log.of(model))


@pytest.mark.parametrize(
    "base, text",
    [
        (Base(np.zeros(1), np.eye(1), 0, np.zeros(1)), "mean has shape"),
        (Base(np.zeros(2), np.eye(3), 0, np.zeros(1)), "cov has shape"),
        (Base(np.zeros(2), np.eye(2), 0, np.zeros(3)), "u has shape"),
    ],
)
def test_a_base_of_another_model(base, text):
    with pytest.raises(EstimatorError, match=text):
        Fold("ekf", TWO, Tuning.of(TWO), Log.of(TWO), base=base)


def test_a_base_of_another_model_has_a_state_of_another_size():
    base = Base(np.zeros(2), np.eye(2), 0, np.zeros(1), "ekf", np.zeros(99))
    growing = Fold("ekf", TWO, Tuning.of(TWO), Log.of(TWO), base=base)
    np.testing.assert_array_equal(growing.moments()[1], np.eye(2))


def test_two_threads_may_be_the_first_to_check_a_batch():
    """In a process of its own, as the check is compiled once."""
    code = (
        "import threading; from estimators.events.checks import _looking\n"
        "both, found = threading.Barrier(2), []\n"
        "def look(): both.wait(); found.append(_looking())\n"
        "threads = [threading.Thread(target=look) for _ in range(2)]\n"
        "[thread.start() for thread in threads]; [thread.join() for thread in threads]\n"
        "assert len(found) == 2, found"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
