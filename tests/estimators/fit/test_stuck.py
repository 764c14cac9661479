"""Readings of a sensor that was stuck for a while take no part in a fit."""

import numpy as np

from estimators.fit.fit import fit
from estimators.fit.recording import Recording, repeated, without_stuck
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import MODEL, log_of, simulated

RIGHT = Tuning.of(MODEL).set("Q.level", 0.01).set("R.float", 0.5)
"""The level hardly moves between two readings: without the sensor's noise they would be equal, but it has some."""


def stuck_for(share: float) -> np.ndarray:
    ys = simulated(6, 400, q=0.01)
    ys[100 : 100 + int(share * ys.size)] = ys[100]
    return ys


def test_its_noise_is_that_of_the_rest():
    """A fifth of the readings repeat one; left in, they take R to half of what made the others."""
    found = fit("kf", RIGHT, [Recording(log_of(stuck_for(0.2)))], wanted=("R",), blocks=0)
    assert found.left_out == {"float": 79}
    (line,) = found.lines
    assert line.low < 0.5 < line.high


def test_it_is_left_out_of_the_judgement_too():
    found = fit("kf", RIGHT, [Recording(log_of(stuck_for(0.2)))], wanted=("R",))
    assert found.before.fitted.n + found.before.held_out.n == 400 - 79


def test_what_repeats_itself_by_its_quantum_is_not_stuck():
    """Rounded to 2 with a deviation of 0.7, one reading equals the next in three of four."""
    ys = np.round(simulated(7, 400) / 2.0) * 2.0
    assert np.mean(ys[1:] == ys[:-1]) > 0.4
    assert not repeated(ys, np.sqrt(0.5)).any()


def test_an_asset_at_rest_is_not_stuck():
    """A car that stands and then drives, its speed in steps that are wide beside the noise: 0 is what it should say."""
    speeds = np.concatenate([np.zeros(150), np.abs(np.cumsum(np.resize([1.0, 1.0, -1.0, 1.0], 250)))])
    assert not repeated(speeds, 0.1).any()
    # Noise of ten steps would have moved it.
    assert repeated(speeds, 10.0).sum() == 149


def test_what_the_model_does_not_contradict_takes_part():
    """The level tends to 0 and may rest there, if it moves as far as the noise; it does not rest elsewhere."""
    active, rest = RIGHT.set("Q.level", 2.0), stuck_for(0.2)
    rest[100:180] = 0.0
    assert without_stuck("kf", active, log_of(rest))[1] == {}
    assert without_stuck("kf", active, log_of(stuck_for(0.2)))[1] == {"float": 79}
    assert without_stuck("kf", RIGHT, log_of(rest))[1] == {"float": 79}


def test_what_is_missing_does_not_interrupt():
    ys = stuck_for(0.2)
    ys[110:180:5] = np.nan
    assert repeated(ys, 0.7).sum() == 79 - 14 and not repeated(ys, 0.7)[110:180:5].any()


def test_a_short_run_stays():
    log = log_of(stuck_for(0.03))
    same, found = without_stuck("kf", RIGHT, log)
    assert found == {} and same is log


def test_a_sensor_that_says_nothing_else_is_another_matter():
    assert not repeated(np.full(300, 1.3), 1.0).any()
