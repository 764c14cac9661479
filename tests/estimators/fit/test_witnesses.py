"""What a recording knows and the filter is not told: errors that last count for few, and a fit may aim at them.

Readings of a sensor that was stuck for a while take no part.
"""

import numpy as np
import pytest
from scipy.stats import norm

from estimators.diagnostics.references import references
from estimators.errors import ConfigError
from estimators.fit.aims import LIKELIHOOD, WITNESSES, aim_of, correlation_time
from estimators.fit.entries import Setting
from estimators.fit.fit import fit
from estimators.fit.judge import worths
from estimators.fit.recording import Recording, repeated, without_stuck
from estimators.log import Log
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import MODEL, log_of, simulated
from tests.support import folded


def lasting_errors(seed: int, n: int = 800):
    """A walk, and a sensor that is off by 1 for some 40 readings at a time, beside a little noise."""
    rng = np.random.default_rng(seed)
    x, e, xs, ys = rng.normal(0.0, 2.0), rng.normal(), np.empty(n), np.empty(n)
    for k in range(n):
        if k:
            x = 0.9 * x + rng.normal(0.0, np.sqrt(0.2))
            e = 0.95 * e + rng.normal(0.0, np.sqrt(1.0 - 0.95**2))
        xs[k], ys[k] = x, x + e + rng.normal(0.0, 0.1)
    return xs, ys


def known(xs, ys) -> Log:
    log = log_of(ys)
    log.add_truth(np.arange(xs.size, dtype=float), level=xs)
    return log


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_correlated_values_count_for_few(phi):
    """τ of a first-order autoregression is (1 + φ) / (1 - φ)."""
    rng = np.random.default_rng(1)
    values = np.empty(20_000)
    values[0] = rng.normal()
    for k in range(1, values.size):
        values[k] = phi * values[k - 1] + rng.normal(0.0, np.sqrt(1.0 - phi**2))
    # Sums of lags up to some τ: a deviation of about 2 τ √(τ / n).
    tau = (1.0 + phi) / (1.0 - phi)
    assert abs(correlation_time(values) - tau) < 4.0 * 2.0 * tau * np.sqrt(tau / values.size)


def test_of_nothing_there_is_nothing_to_tell():
    assert correlation_time(np.zeros(0)) == 1.0 and correlation_time(np.full(9, 2.0)) == 1.0


def test_true_states_and_unused_sensors_are_witnesses():
    xs, ys = lasting_errors(0, 50)
    log = known(xs, ys)
    log.add("silent", np.arange(50.0) + 0.5, ys)
    tuning = Tuning.of(MODEL).set("use.silent", False)
    fold = folded("kf", MODEL, log, tuning)
    truth, sensor = references(MODEL, log.events, fold.track)
    assert (truth.name, truth.truth, sensor.name, sensor.truth) == ("level", True, "silent", False)
    np.testing.assert_array_equal(truth.error, xs - fold.track.mean[truth.rows, 0])
    np.testing.assert_allclose(sensor.error, ys - fold.track.mean[sensor.rows, 0], atol=1e-12)
    expected = norm.logpdf(xs, fold.track.mean[truth.rows, 0], fold.track.std[truth.rows, 0])
    np.testing.assert_allclose(truth.log_density, expected, rtol=0, atol=1e-12)


def test_each_weighs_as_much_as_it_has_independent_errors():
    xs, ys = lasting_errors(1)
    log, given = known(xs, ys), Setting(Tuning.of(MODEL).set("Q.level", 0.2).set("R.float", 0.01), None)
    whole = Recording(log, 1.0, np.zeros(log.n, bool))
    aim = aim_of(WITNESSES, "kf", given, [whole], ())
    # Its squares are correlated by 0.95² from one to the next: 20 readings are one.
    assert aim.kind == WITNESSES and 1 / 40 < aim.weights["level"] < 1 / 10
    assert aim_of(WITNESSES, "kf", given, [Recording(log_of(ys), 1.0, np.zeros(ys.size, bool))], ()).kind == LIKELIHOOD


def test_a_fit_that_aims_at_them_keeps_its_band_better_than_the_likelihood_alone():
    """The sensor's error cannot be told from the walk by its readings: they call it a quick walk, seen sharply."""
    inside = {LIKELIHOOD: [], WITNESSES: []}
    for seed in range(6):
        first, second = known(*lasting_errors(seed)), known(*lasting_errors(100 + seed))
        for aim in inside:
            found = fit("kf", Tuning.of(MODEL).set("R.float", 0.25), [Recording(first)], aim=aim, blocks=0)
            unseen = Recording(second, 1.0, np.ones(second.n, bool))
            (worth,) = worths("kf", [found.setting], [unseen], lambda folds: True)
            inside[aim].append(worth.held_out.states["level"].coverage)
    # No Q and R are right for both: white noise is what the readings see, and an error that lasts what the truth does.
    # At equal weight the share outside the band of 95 % is less than half of what the readings alone leave there.
    assert np.mean(inside[LIKELIHOOD]) < 0.6
    assert 1.0 - np.mean(inside[WITNESSES]) < 0.5 * (1.0 - np.mean(inside[LIKELIHOOD]))


def test_without_a_witness_it_is_the_likelihood():
    ys = simulated(3, 200)
    one, other = (fit("kf", Tuning.of(MODEL), [Recording(log_of(ys))], aim=aim) for aim in (LIKELIHOOD, WITNESSES))
    assert [line.after for line in one.lines] == [line.after for line in other.lines]


def test_the_noise_of_a_sensor_that_is_held_out_is_told_by_its_own_prediction():
    rng = np.random.default_rng(3)
    xs, ys = lasting_errors(2)
    log = log_of(ys)
    log.add("silent", np.arange(xs.size, dtype=float), xs + rng.normal(0.0, 2.0, xs.size))
    tuning = Tuning.of(MODEL).set("use.silent", False)
    with pytest.raises(ConfigError, match="R.silent belongs to a held-out sensor"):
        fit("kf", tuning, [Recording(log)], wanted=("R.silent",))
    found = fit("kf", tuning, [Recording(log)], wanted=("Q", "R"), aim=WITNESSES)
    # It reads with a variance of 4, beside what the estimate is off by, about 1.
    (line,) = [line for line in found.lines if line.key == "R.silent"]
    assert found.proposed and abs(np.log(line.after / 4.0)) < np.log(1.5)
    after, before = (worth.held_out.withheld["silent"].coverage for worth in (found.after, found.before))
    assert before < 0.8 and 0.9 < after < 0.98


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
