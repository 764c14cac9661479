"""The interface by name: the same fold beneath, errors that say what to write, and scores against their definitions."""

import json
import re
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import chi2

from estimators import MODELS, Log, Noise, Parameter, Row, Sensor, State, StateSpaceModel, fold, fold_many, mean_nees
from estimators.diagnostics.consistency import Nees
from estimators.errors import EstimatorError, EventError, NisusError
from estimators.fold import fold as fold_track
from estimators.log import INPUT, READING, TRUTH
from estimators.model.assemble import JointParameter, joint
from estimators.models.uwb_rover import HEADING, YAW_RATE_BIAS
from estimators.track import HELD_OUT, USED
from estimators.tuning import Tuning
from tests.cases import cases
from tests.models import unchanged
from tests.support import SECOND, assert_same, error_of, folded, log_of, measured, run_python

MOTOR = MODELS["motor_winding"]
DRIVE = MODELS["motor_drive"]
ROAD = MODELS["road_car"]
CELSIUS = [40.3, 41.0, np.nan, 41.2, 39.9]


def motor_log(**given):
    return measured(MOTOR, "winding", [1, 2, 3, 4, 5], CELSIUS, **given)


def test_it_is_the_fold_of_events_and_a_tuning():
    log = log_of(MOTOR.width, *((second, READING, celsius) for second, celsius in enumerate(CELSIUS, start=1)))
    tuning = Tuning.of(MOTOR).set("R.winding", 9.0).set("gate", 0.99).with_options({"alpha": 0.5})
    expected = fold_track("ukf", MOTOR, tuning, log)
    got = fold("ukf", MOTOR, motor_log(), R={"winding": 9.0}, gate=0.99, alpha=0.5)
    assert_same(got.track, expected)
    np.testing.assert_array_equal(got.seconds, [1.0, 2.0, 3.0, 4.0, 5.0])
    assert got.log_likelihood == pytest.approx(np.nansum(expected.log_likelihood))


def test_any_order_and_any_pieces_give_the_same_log():
    whole, pieces = motor_log(), Log.of(MOTOR)
    for k in (3, 0, 4, 2, 1):
        pieces.add("winding", k + 1.0, CELSIUS[k])
    assert_same(whole.events, pieces.events)


def test_the_prior_holds_at_the_start():
    """The first reading comes 10 s after the prior, so its innovation is that much less certain."""
    early, late = (Log.of(MOTOR, start=start) for start in (-9.0, None))
    for log in (early, late):
        log.add("winding", 1.0, 40.0)
    early.add_ticks(-9.0)
    track = fold("kf", MOTOR, early)
    np.testing.assert_allclose(track.mean[0], MOTOR.prior_mean)
    np.testing.assert_allclose(track.std[0], MOTOR.prior_std)
    assert track.track.innovation_std[1, 0] > 1.5 * fold("kf", MOTOR, late).track.innovation_std[0, 0]
    with pytest.raises(EventError, match="1 of 2 times are before -9 s, where the log starts"):
        early.add("winding", [-10.0, 5.0], [40.0, 40.0])


def test_inputs_and_truth_by_name():
    log = Log.of(DRIVE)
    u, x = DRIVE.input_names, DRIVE.state_names
    log.add_inputs([1.0, 2.0], **{u[0]: [3.0, np.nan], u[-1]: 7.0})
    log.add_truth([2.0, 3.0], **{x[0]: 5.0, x[-1]: [6.0, np.nan]})
    events = log.events
    assert events.kind.tolist() == [INPUT, INPUT, TRUTH, TRUTH]
    np.testing.assert_array_equal(events.value[:2, 0], [3.0, np.nan])
    np.testing.assert_array_equal(events.value[:2, DRIVE.nu - 1], 7.0)
    np.testing.assert_array_equal(events.value[2:, 0], 5.0)
    np.testing.assert_array_equal(events.value[2:, DRIVE.nx - 1], [6.0, np.nan])


def test_truth_of_far_apart_states_of_a_field_is_told_in_blocks():
    model = MODELS["lorenz96"]
    log = Log.of(model)
    names = model.state_names
    log.add_truth(1.0, **{names[39]: 9.0, names[0]: 1.0, names[31]: 3.0})
    assert log.events.channel.tolist() == ([0] if model.width >= 40 else [0, 39])
    np.testing.assert_array_equal(np.sort(log.events.value[np.isfinite(log.events.value)]), [1.0, 3.0, 9.0])


def assert_refused(log, says, call, *given, **named):
    assert re.search(says, error_of(NisusError, call, *given, **named)) and log.n == 5


@cases(__file__, "refused_events.csv")
def test_events_that_do_not_fit_are_told_what_to_write(method, given, named, says):
    log = motor_log()
    assert_refused(log, says, getattr(log, method), *json.loads(given), **json.loads(named))


@cases(__file__, "refused_folds.csv")
def test_settings_that_do_not_fit_are_told_what_to_write(estimator, named, says):
    log = motor_log()
    assert_refused(log, says, fold, estimator, MOTOR, log, **json.loads(named))


def test_what_does_not_fit_the_log_is_told_what_to_write():
    log = motor_log()
    other = "the log is of motor_winding, with the sensors winding; road_car has"
    assert_refused(log, other, fold, "ekf", ROAD, log)
    assert_refused(log, "executor is 'cloud'; it must be", fold_many, "kf", MOTOR, log, executor="cloud")
    assert_refused(log, "covariance=True", fold("kf", MOTOR, log).nees)
    assert_refused(log, "log.add_truth", fold("kf", MOTOR, log, covariance=True).nees)


def test_a_log_of_no_model_knows_no_names():
    with pytest.raises(EventError, match=r"add: this log has no model.*Log.of\(model\)"):
        Log(2).add("winding", 1.0, 2.0)


def test_words_for_choices():
    log = motor_log()
    by_word = fold("pf", MOTOR, log, seed=3, resampling="stratified", particles=100)
    by_number = fold("pf", MOTOR, log, seed=3, resampling=by_word.tuning.options["resampling"], particles=100)
    assert isinstance(by_word.tuning.options["resampling"], float)
    assert_same(by_word.track, by_number.track)
    other = fold("pf", MOTOR, log, seed=4, resampling="stratified", particles=100)
    assert not np.array_equal(other.mean, by_word.mean)


def test_held_out_sensors_and_parts_of_r():
    rows = ROAD.sensors[0]
    log = measured(ROAD, rows.name, [1.0, 2.0], np.zeros((2, len(rows.rows))))
    kept = fold("ekf", ROAD, log, R={rows.name: 2.0})
    held = fold("ekf", ROAD, log, R={rows.name: [2.0] * len(rows.rows)}, held_out=[rows.name])
    assert kept.track.verdict.tolist() == [USED] * 2 and held.track.verdict.tolist() == [HELD_OUT] * 2
    np.testing.assert_array_equal(kept.track.innovation_std[0], held.track.innovation_std[0])
    assert kept.readings(rows.name).tolist() == [0, 1] and list(held.score().held_out)


def test_the_table_has_a_column_a_state():
    log = motor_log()
    log.add("winding", 6.0, 40.0, variance=2.5)
    log.add_truth(6.0, temperature=40.5)
    log.add_ticks(7.0)
    track = fold("ukf", MOTOR, log)
    table = track.table()
    frame = table.to_pandas()
    assert len(frame) == len(track) == 8
    for k, name in enumerate(MOTOR.state_names):
        np.testing.assert_array_equal(frame[name], track.mean[:, k])
        np.testing.assert_array_equal(frame[f"{name}_std"], track.std[:, k])
    np.testing.assert_array_equal(frame["nis"], track.nis)
    assert frame["verdict"].tolist()[:4] == ["used", "used", "missing", "used"]
    assert frame["sensor"].isna().tolist() == [False] * 6 + [True, True]
    assert frame["event"].tolist()[5:] == ["reading", "truth", "tick"]
    assert frame["variance_0"].tolist()[5] == 2.5 and np.isnan(frame["variance_0"][0])
    assert frame["temperature_true"][6] == 40.5


def test_the_estimates_keep_what_was_folded():
    log = motor_log()
    track = fold("kf", MOTOR, log)
    log.add("winding", 0.5, 40.0)
    assert len(track.table()) == 5 and track.seconds[0] == 1.0


def test_the_covariance_is_whole():
    """The filter's own matrix: variances on its diagonal, and cov at the end is what the state holds."""
    rng = np.random.default_rng(1)
    model = MODELS["lorenz63"]
    log = measured(model, model.sensor_names[0], np.arange(1, 6) * 0.1, rng.normal(0, 5, (5, 3)))
    track = fold("ekf", model, log, covariance=True)
    np.testing.assert_allclose(np.sqrt(np.diagonal(track.cov, axis1=1, axis2=2)), track.std, rtol=1e-14)
    np.testing.assert_array_equal(track.cov, np.transpose(track.cov, (0, 2, 1)))
    growing = folded("ekf", MODELS["lorenz63"], log, track.tuning)
    np.testing.assert_allclose(track.cov[-1], growing.moments()[1], rtol=1e-12)


def test_the_covariance_of_estimated_states_contains_the_considered_ones():
    """Of two levels that share an offset: Schmidt's gain moves only them, and P = (I - K H) P (I - K H)ᵀ + K R Kᵀ.

    Without noise of the process or time between measurements, so the recursion is that of the update alone.
    """

    def both(x, u, p, out):
        out[0] = x[0] + x[1] + p[0]

    levels = StateSpaceModel(
        "levels", "levels", states=(State("a", "1", 0.0, 1.0), State("b", "1", 0.0, 2.0)), f=unchanged, linear=True,
        parameters=(Parameter("offset", "1", 0.0),), noises=(Noise("a", "1/s", 0.0),),
        sensors=(Sensor("y", (Row("y", "1", 0.04),), h=both),),
    )  # fmt: skip
    model = joint(levels, {"offset": JointParameter(0.3, considered=True)})
    log = measured(model, "y", [0.0, 0.0], [0.1, 0.2], start=0.0)
    log.add_truth([0.0], a=[0.5], b=[0.25])
    track = fold("ekf", model, log, covariance=True)
    P, H = np.diag([1.0, 4.0, 0.09]), np.ones((1, 3))
    for _ in range(2):
        K = P @ H.T / (H @ P @ H.T + 0.04)
        K[2] = 0.0
        A = np.eye(3) - K @ H
        P = A @ P @ A.T + 0.04 * K @ K.T
    np.testing.assert_allclose(track.cov[-1], P[:2, :2], rtol=0, atol=1e-12)
    error = np.array([0.5, 0.25]) - track.mean[-1]
    assert track.nees().value == pytest.approx(error @ np.linalg.solve(P[:2, :2], error), rel=1e-9)


def test_nees_is_its_definition():
    log = motor_log()
    log.add_truth([1.5, 4.5], temperature=[39.0, 42.0], rate=[0.1, np.nan])
    track = fold("kf", MOTOR, log, covariance=True)
    got = track.nees()
    rows = np.flatnonzero(track.events.kind == TRUTH)
    error = np.array([39.0, 0.1]) - track.mean[rows[0]]
    whole = error @ np.linalg.inv(track.cov[rows[0]]) @ error
    part = ((42.0 - track.mean[rows[1], 0]) / track.std[rows[1], 0]) ** 2
    np.testing.assert_allclose(got.value, [whole, part], rtol=1e-10)
    assert got.dof.tolist() == [2, 1] and got.seconds.tolist() == [1.5, 4.5]
    np.testing.assert_allclose(got.low, chi2.ppf(0.025, [2, 1]), rtol=1e-9)
    np.testing.assert_allclose(got.high, chi2.ppf(0.975, [2, 1]), rtol=1e-9)
    assert got.mean == pytest.approx((whole + part) / 3)
    twice = mean_nees([got, got._replace(value=3.0 * got.value)])
    np.testing.assert_allclose(twice.value, 2.0 * got.value)
    np.testing.assert_allclose(twice.high, chi2.ppf(0.975, [4, 2]) / 2, rtol=1e-9)


def test_nees_of_many_times_is_a_plain_loop_with_solve():
    """A rover with an angle, over times that know all, some or none of the states, and one that is known twice."""
    model = MODELS["uwb_rover"]
    rng = np.random.default_rng(3)
    log = Log.of(model, start=0.0)
    times = np.arange(1.0, 61.0)
    log.add("range_1", times, 10.0 + rng.normal(0, 0.2, times.size))
    truth = rng.normal(0.0, 3.0, (times.size, model.nx))
    truth[rng.random(truth.shape) < 0.4] = np.nan
    truth[:20] = rng.normal(0.0, 3.0, (20, model.nx))
    truth[30] = np.nan
    log.add_truth(times, **dict(zip(model.state_names, truth.T, strict=True)))
    log.add_truth(7.0, heading=0.25)
    truth[6, HEADING] = 0.25
    # With a prior of deviation 0, P has no inverse at first.
    prior = (model.prior_mean, np.diag([4.0, 4.0, 1.0, 0.0, 0.01, 0.1, 0.1, 0.1, 0.1]))
    track = fold("ekf", model, log, covariance=True, prior=prior, Q={"yaw_rate_bias": 0.0})
    got = track.nees()
    expected, dof = [], []
    for second, true in zip(times, truth, strict=True):
        known = np.isfinite(true)
        if not known.any():
            continue
        row = np.flatnonzero(track.events.t == round(second * SECOND))[-1]
        e = true - track.mean[row]
        e[HEADING] = np.arctan2(np.sin(e[HEADING]), np.cos(e[HEADING]))
        P = track.cov[row][np.ix_(known, known)]
        singular = bool(known[YAW_RATE_BIAS])
        assert singular == (np.linalg.matrix_rank(P) < len(P))
        expected.append(np.nan if singular else e[known] @ np.linalg.solve(P, e[known]))
        dof.append(known.sum())
    assert 10 < np.sum(np.isnan(expected)) < 50
    # A condition of P up to 1e6 leaves ten digits.
    np.testing.assert_allclose(got.value, expected, rtol=1e-9)
    assert got.dof.tolist() == dof


def test_nees_makes_as_many_calls_for_any_number_of_events():
    """It works on whole arrays: a call for each event would cost more than the filtering."""

    def calls(count):
        log = Log.of(MOTOR, start=0.0)
        times = np.arange(1.0, count + 1.0)
        log.add("winding", times, np.full(times.size, 40.0))
        log.add_truth(times, temperature=times, rate=times)
        track = fold("kf", MOTOR, log, covariance=True)
        track.nees()  # what it loads, it loads once
        made = []
        sys.setprofile(lambda frame, event, function: made.append(event))
        try:
            track.nees()
        finally:
            sys.setprofile(None)
        return len(made)

    assert calls(20) == calls(2000) > 100


def test_a_mean_nees_is_given_the_estimates_themselves():
    logs = [simulated(seed) for seed in range(3)]
    runs = fold_many("kf", MOTOR, logs, covariance=True)
    right = mean_nees([run.nees() for run in runs])
    for given in (runs, tuple(runs), [runs[0], runs[1].nees(), runs[2]]):
        np.testing.assert_array_equal(mean_nees(given).value, right.value)
    for one in (runs[0], runs[0].nees()):
        np.testing.assert_array_equal(mean_nees(one).value, runs[0].nees().value)
    with pytest.raises(EstimatorError, match="run is of type ndarray; give what fold.*covariance=True.* returns"):
        mean_nees([run.mean for run in runs])
    with pytest.raises(EstimatorError, match="fold with covariance=True"):
        mean_nees(fold_many("kf", MOTOR, logs))


def test_bounds_of_the_mean_nees_hold_95_of_100_means():
    """1,000 runs of 2,000 correlated ε of 3 states: a mean over time inside its bounds, as often as they promise."""
    rng = np.random.default_rng(5)
    runs, n, phi = 1000, 2000, 0.8
    e = rng.standard_normal((runs, 3))
    values = np.empty((runs, n))
    for k in range(n):
        e = phi * e + np.sqrt(1 - phi**2) * rng.standard_normal((runs, 3))
        values[:, k] = np.sum(e**2, axis=1)
    inside, plain = 0, 0
    for value in values:
        run = Nees(np.arange(n), value, np.full(n, 3), np.zeros(n), np.ones(n))
        low, high = run.mean_bounds
        inside += low <= run.mean <= high
        plain += chi2.ppf(0.025, 3 * n) / (3 * n) <= run.mean <= chi2.ppf(0.975, 3 * n) / (3 * n)
    # Four standard errors of a share of 1,000 are 2.8 %; bounds of independent values would hold far fewer.
    assert abs(inside / runs - 0.95) < 0.028 and plain / runs < 0.85


def simulated(seed):
    """A motor by its own equations, x' = (T + r, r) + w a second: truth and readings that no fold had a part in."""
    rng = np.random.default_rng(seed)
    x = rng.normal(MOTOR.prior_mean, MOTOR.prior_std)
    times, states, readings = np.arange(1.0, 31.0), [], []
    for _ in times:
        x = np.array([x[0] + x[1], x[1]]) + rng.normal(0.0, np.sqrt([noise.variance for noise in MOTOR.noises]))
        states.append(x)
        readings.append(x[0] + rng.normal(0.0, 3.0))
    log = measured(MOTOR, "winding", times, readings, start=0.0)
    log.add_truth(times, **dict(zip(MOTOR.state_names, np.array(states).T, strict=True)))
    return log


def test_a_consistent_filter_is_inside_its_bounds_and_a_confident_one_is_not():
    """40 runs, 30 times: 95 % of the means within χ² bounds; with hardly any Q far fewer."""
    logs = [simulated(seed) for seed in range(40)]
    right = mean_nees([t.nees() for t in fold_many("kf", MOTOR, logs, R={"winding": 9.0}, covariance=True)])
    # Of 30 correlated values at 95 % some may be outside; a third of them would be no chance.
    assert right.runs == 40 and right.inside > 0.67 and 0.8 < right.mean < 1.2
    small = {noise.name: noise.variance / 100 for noise in MOTOR.noises}
    confident = fold_many("kf", MOTOR, logs, R={"winding": 9.0}, Q=small, covariance=True)
    wrong = mean_nees([t.nees() for t in confident])
    # The prior's share of the error goes; then what Q leaves out counts.
    assert np.all(wrong.value[-10:] > wrong.high[-10:]) and wrong.mean > 1.4


@pytest.mark.parametrize("executor", ["threads", None, "own"])
def test_many_seeds_are_the_folds_one_by_one(executor):
    log = motor_log()
    pool = ThreadPoolExecutor(2) if executor == "own" else executor
    many = fold_many("pf", MOTOR, log, seeds=range(5), executor=pool, particles=50)
    for seed, track in enumerate(many):
        assert track.tuning.seed == seed
        assert_same(track.track, fold("pf", MOTOR, log, seed=seed, particles=50).track)
    if executor == "own":
        assert pool.submit(int, 3).result() == 3
        pool.shutdown()


def test_several_logs_and_processes():
    logs = [motor_log(), motor_log(start=0.0)]
    many = fold_many("enkf", MOTOR, logs, seeds=(1, 2), executor="processes", members=10)
    assert [track.tuning.seed for track in many] == [1, 2, 1, 2]
    expected = [fold("enkf", MOTOR, log, seed=seed, members=10) for log in logs for seed in (1, 2)]
    for a, b in zip(many, expected, strict=True):
        assert_same(a.track, b.track)


def test_the_import_loads_no_numerics():
    """A name loads what it needs; the package itself nothing, and its `fold` stays the function."""
    code = """
import sys
import estimators
assert not {"numba", "numpy", "scipy"} & set(sys.modules), "loaded"
assert "fold" in dir(estimators)
import estimators.fold
from estimators import fold
from estimators.fold import Fold
assert callable(fold) and fold.__module__ == "estimators.interface.by_name"
try:
    estimators.nothing
except AttributeError as error:
    assert "nothing" in str(error)
"""
    run_python(code)
