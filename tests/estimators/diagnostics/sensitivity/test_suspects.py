"""Who is to blame: single faults of a simulated motor, whose names and sizes are known."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.sensitivity.suspects import NO_EXPLANATION, in_words, likeliest, odds, suspects
from estimators.log import INPUT, Log
from estimators.models import MODELS
from estimators.tuning import Tuning
from sources.simulator import Simulator, constant_input, stepped_input
from tests.support import read_all

from .models import WALK

MODEL = MODELS["motor_drive"]
SINCE = 60.0
PARAMETERS = [item.name for item in MODEL.parameters]


@pytest.fixture(scope="module")
def log():
    """Two minutes of the motor, drawn from the model that the filter believes, under a load that changes.

    With the noise of some seeds (4, 6 to 9) a winding_tooth that is too small explains the drift of the winding nearly
    as well, and both are stated with odds; with that of seed 0 it does not.
    """
    inputs = {
        "i_q": stepped_input((0.0, 20.0, 70.0, 90.0), (60.0, 200.0, 120.0, 240.0)),
        "speed": stepped_input((0.0, 30.0, 80.0), (150.0, 350.0, 200.0)),
        "coolant": constant_input(40.0),
        "ambient": constant_input(22.0),
    }
    found = Log.of(MODEL)
    found.extend(read_all(Simulator(MODEL, seed=0, step=0.1, duration=120.0, inputs=inputs)))
    return found


def off(log, sensor, error):
    """A copy in which the readings of a sensor are off from `SINCE` on, by the error at the seconds since."""
    wrong = log.copy()
    rows = wrong.events.of_sensor(sensor)
    rows = rows[wrong.t[rows] >= SINCE * 1e9]
    wrong.value[rows, 0] += error(wrong.t[rows] * 1e-9 - SINCE)
    return wrong


def blamed(log):
    return suspects("ekf", MODEL, Tuning.of(MODEL), log, SINCE)


def test_nobody_is_blamed_for_what_is_as_it_should_be(log):
    """Twice log Λ of one fault is χ² with one degree of freedom; the largest of k independent ones stays below this."""
    found = blamed(log)
    assert found[0].gain < 0.5 * (2.0 * np.log(len(found)) + 9.0)


@pytest.mark.parametrize("sensor", MODEL.sensor_names)
def test_the_sensor_that_is_off_by_so_much(log, sensor):
    size = 1.5
    wrong = off(log, MODEL.sensor_names.index(sensor), lambda t: size)
    first = blamed(wrong)[0]
    assert (first.nudge.kind, first.nudge.name) == ("sensor", sensor)
    assert abs(first.size - size) < 4.0 * first.deviation
    assert in_words(blamed(wrong)).startswith(f"sensor {sensor} +")


@pytest.mark.parametrize("sensor", MODEL.sensor_names)
def test_the_sensor_that_drifts_by_so_much(log, sensor):
    """It is not said to be off by a constant, nor is anything else."""
    rate = 0.05
    found = blamed(off(log, MODEL.sensor_names.index(sensor), lambda t: rate * t))
    assert (found[0].nudge.kind, found[0].nudge.name) == ("drift", sensor)
    assert abs(found[0].size - rate) < 4.0 * found[0].deviation
    assert in_words(found) == f"sensor {sensor} drifting by {found[0].size:+.3g} °C/s"


def test_an_input_that_is_off(log):
    wrong = log.copy()
    k = MODEL.input_names.index("coolant")
    given = wrong.kind[: wrong.n] == INPUT
    # What holds since before is told anew where the fault begins.
    late = given & (wrong.t[: wrong.n] >= SINCE * 1e9)
    at = int(np.searchsorted(wrong.t[: wrong.n], round(SINCE * 1e9)))
    value = np.full((1, MODEL.width), np.nan)
    value[0, k] = 40.0 + 15.0
    wrong.value[: wrong.n][late, k] = 55.0
    wrong.extend(
        wrong.events.select(slice(at, at + 1))._replace(
            kind=np.array([INPUT], np.int8), channel=np.array([0], np.int32), value=value
        )
    )
    found = blamed(wrong)
    coolant = next(suspect for suspect in found if suspect.nudge.name == "coolant")
    assert found[0].gain - coolant.gain < 3.0 and abs(coolant.size - 15.0) < 4.0 * coolant.deviation


@pytest.mark.parametrize(("factor", "word"), [(0.7, "small"), (1.4, "large")])
def test_a_parameter_of_the_twin_that_is_too_small_or_too_large(log, factor, word):
    """The words name the error of the twin's value, in percent of it."""
    p = Tuning.of(MODEL).p.copy()
    k = PARAMETERS.index("capacity_winding")
    p[k] *= factor
    found = suspects("ekf", MODEL, replace(Tuning.of(MODEL), p=p), log, SINCE)
    wrong = next(one for one in found if one.nudge.name == "capacity_winding")
    assert wrong.size * (factor - 1.0) > 0.0
    assert f"capacity_winding too {word} by " in in_words([wrong])


def test_a_parameter_without_its_error_lies_in_its_range(log):
    """An offset of a sensor would need a capacity below zero, or a change far beyond what a refold confirms."""
    for one in blamed(off(log, 0, lambda t: 30.0)):
        if one.nudge.kind == "parameter":
            item = MODEL.parameters[PARAMETERS.index(one.nudge.name)]
            assert item.low <= item.value - one.size <= item.high


def test_what_lasts_is_cut_and_what_is_before_is_left_alone(log):
    before = [column.copy() for column in log.events]
    blamed(log)
    for column, kept in zip(log.events, before, strict=True):
        np.testing.assert_array_equal(column, kept)


def walk_log(disturbed):
    """A random walk of 300 s under a push that the model knows, with a disturbance (300,) in the measurements."""
    rng, n = np.random.default_rng(2), 300
    found = Log.of(WALK)
    found.add_inputs(np.arange(n), push=np.full(n, -1.0))
    y = 0.5 * rng.normal(size=n) + np.cumsum(0.2 * rng.normal(size=n)) + disturbed
    found.add("level", np.arange(n), y)
    return found


def test_explanations_that_are_equally_good_have_equal_odds():
    """The walk drifts by the sum of an input and a parameter: an error of either is the same."""
    found = suspects("ekf", WALK, Tuning.of(WALK).set("p.slope", 0.1), walk_log(np.zeros(300)), 20.0)
    alike = likeliest(found)
    share = {suspect.nudge.subject: value for suspect, value in zip(alike, odds(alike), strict=True)}
    assert share["input push"] == pytest.approx(share["parameter slope"], rel=0.01)
    assert sum(share.values()) == pytest.approx(1.0) and " %) or " in in_words(found)


def test_what_no_quantity_explains_is_said_so():
    """Neither an offset nor a drift, scale or delay explains that a sensor swings."""
    found = suspects("ekf", WALK, Tuning.of(WALK), walk_log(6.0 * (np.arange(300) // 40 % 2)), 20.0)
    assert likeliest(found) == () and in_words(found) == NO_EXPLANATION
    assert in_words(suspects("ekf", WALK, Tuning.of(WALK), walk_log(np.zeros(300)), 20.0)) == ""
