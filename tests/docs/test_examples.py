"""The scripts of the guides run, and their results agree with figures computed independently."""

import importlib.util
import runpy
import sys

import numpy as np
import pytest
from scipy import stats

from estimators import fold
from estimators.log import TRUTH
from tests import ROOT

EXAMPLES = ROOT / "docs" / "examples"


def example(name):
    """Return a script as a module; Numba looks for it by its name when it loads compiled functions."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def true_states(run):
    """Rows of the true states, and their values (n, nx)."""
    rows = np.flatnonzero(run.events.kind == TRUTH)
    return rows, run.events.value[rows, : run.model.nx]


def nees(run):
    """Normalised estimation error squared at every true state, with the errors as they are."""
    rows, truth = true_states(run)
    error = truth - run.mean[rows]
    error[:, run.model.circular] = np.angle(np.exp(1j * error[:, run.model.circular]))
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(run.cov[rows]), error)


def test_the_filters_that_are_compared_are_as_consistent_as_the_script_says():
    seeds = 100
    found = example("compare_filters").compare(seeds=seeds)
    low, high = stats.chi2.ppf([0.025, 0.975], 2 * seeds) / seeds
    for name, (runs, told) in found.items():
        value = np.mean([nees(run) for run in runs], axis=0)
        np.testing.assert_allclose(told.value, value, rtol=1e-6)
        inside = np.mean((value > low) & (value < high))
        assert told.inside == pytest.approx(inside, abs=0.011)
        if name in ("ekf", "ukf"):
            # 200 correlated times, of which 95 % are expected inside.
            assert inside > 0.85
            assert abs(value.mean() / 2 - 1) < 0.1
            # A single measurement gives the angle to 0.05 m / cos(angle) at best.
            errors = [run.mean[rows, 0] - truth[:, 0] for run in runs for rows, truth in [true_states(run)]]
            assert np.sqrt(np.mean(np.square(errors))) < 0.05


def test_an_angle_is_estimated_across_the_turn():
    alone = runpy.run_path(str(EXAMPLES / "custom_model_with_angles.py"))  # under no module name
    first = fold("ekf", alone["BOAT"], alone["simulate"](duration=5.0))
    module = example("custom_model_with_angles")
    log = module.simulate()
    run = fold("ekf", module.BOAT, log, covariance=True)
    np.testing.assert_array_equal(first.mean, fold("ekf", module.BOAT, module.simulate(duration=5.0)).mean)
    rows, truth = true_states(run)
    assert np.abs(np.diff(truth[:, 0])).max() > 6.0, "the true heading crosses ±π"
    error = np.angle(np.exp(1j * (truth[:, 0] - run.mean[rows, 0])))
    late = run.seconds[rows] > 20.0
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.1, "better than one measurement of the compass"
    assert abs(run.mean[-1, 2] - 0.03) < 3.0 * run.std[-1, 2] < 0.01
    # One run of correlated errors: its mean NEES stays within a wide band about 1 per state.
    assert 0.5 < np.mean(nees(run)) / 3 < 1.8


def test_a_recorded_log_is_fitted_and_smoothed():
    log, fitted, filtered, smoothed = example("fit_and_smooth").fit_and_smooth()
    assert fitted.log_likelihood[-1] > fitted.log_likelihood[0]
    model, events = filtered.model, log.events
    rows, values = true_states(filtered)
    known = np.isfinite(values).all(axis=1)
    rows, values = rows[known], values[known]
    before, after = (np.sqrt(np.mean((run.mean[rows] - values) ** 2, axis=0)) for run in (filtered, smoothed))
    assert np.all(after < 1.02 * before) and after[model.state_names.index("magnet")] < 0.9 * before.max()
    # The fitted noise is what separates the thermocouples from the true temperatures.
    for k, sensor in enumerate(model.sensors):
        mine = events.of_sensor(k)
        state = model.state_names.index(sensor.name)
        true = np.interp(events.t[mine], events.t[rows], values[:, state])
        error = events.value[mine, 0] - true
        error = error[np.isfinite(error)]
        spread = 4.0 / np.sqrt(2 * error.size)
        assert np.sqrt(fitted.tuning.r[k]) == pytest.approx(error.std(), rel=spread)


def test_fused_twins_are_as_consistent_as_each():
    """Information that is added counts the thermocouples twice: its error is beyond its band too often."""
    found = example("two_twins").two_twins()
    times = len(found["edge"][0])
    assert times == 185 and {len(error) for error, _ in found.values()} == {times}
    inside = {
        name: np.mean(np.abs(error) <= 2.0 * np.sqrt(np.diagonal(cov, axis1=1, axis2=2)), axis=0)
        for name, (error, cov) in found.items()
    }
    assert inside["edge"].min() > 0.93 and inside["thermal"].min() > 0.93 and inside["fused"].min() > 0.93
    assert inside["added"].min() < 0.9
    rmse = {name: np.sqrt(np.mean(error**2)) for name, (error, _) in found.items()}
    assert rmse["fused"] < min(rmse["edge"], rmse["thermal"])
    sizes = {name: np.linalg.det(cov) for name, (_, cov) in found.items()}
    assert np.all(sizes["fused"] <= np.minimum(sizes["edge"], sizes["thermal"]) * (1.0 + 1e-9))


def test_the_script_of_a_package_that_is_not_installed_compiles():
    path = EXAMPLES / "kafka_to_fleet.py"
    compile(path.read_text(), str(path), "exec")
