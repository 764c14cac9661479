"""The search and the curvature at its end against a plain Kalman likelihood in NumPy, maximised by SciPy.

Maximum likelihood without a prior against statsmodels with the same start; the published Nile: tests/textbook.py.
"""

from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from scipy.optimize import minimize

from estimators.fit.entries import entries_of
from estimators.fit.fit import Fitted, fit
from estimators.fit.objective import Objective, maximise
from estimators.fit.recording import Recording
from estimators.fit.uncertainty import MAX_CORRELATION, curvature
from estimators.log import Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.models import constant_speed, first_state, level_model, second_state

DECADES = 2.0 * np.log(10.0)  # Deviation of the weak prior of a variance
NAMES = ("a", "b", "c")
READINGS = 1500
TRUTH = {"a": (0.3, 1.0), "b": (0.02, 0.5), "c": (1.0, 0.2)}  # Variances of the steps and of the sensor


def step(x, u, p, dt, out):
    for i in range(3):
        out[i] = x[i]


def third(x, u, p, out):
    out[0] = x[2]


WALKS = StateSpaceModel(
    name="walks",
    title="three walks that have nothing in common",
    states=tuple(State(name, "", 0.0, 2.0) for name in NAMES),
    noises=tuple(Noise(name, "1/s", 0.1) for name in NAMES),
    sensors=tuple(
        Sensor(name, (Row(name, "", 1.0),), h=h)
        for name, h in zip(NAMES, (first_state, second_state, third), strict=True)
    ),
    f=step,
    linear=True,
)


def density(ys: np.ndarray, q: float, r: float) -> float:
    """Return the log density of the measurements of one walk, by scalar recursion."""
    x, P, total = 0.0, 4.0, 0.0
    for k, y in enumerate(ys):
        P += q if k else 0.0
        S = P + r
        total -= 0.5 * (np.log(2.0 * np.pi * S) + (y - x) ** 2 / S)
        x, P = x + P / S * (y - x), P * r / S
    return total


@pytest.fixture(scope="module")
def series() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {
        name: np.cumsum(rng.normal(0.0, np.sqrt(q), READINGS)) + rng.normal(0.0, np.sqrt(r), READINGS)
        for name, (q, r) in TRUTH.items()
    }


@pytest.fixture(scope="module")
def theirs(series) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Logarithms of q and r of each walk at the maximum with the weak prior, and minus the second derivatives there."""
    found = {}
    for name, ys in series.items():
        start = np.log([0.1, 1.0])

        def loss(x: np.ndarray, ys: np.ndarray = ys, start: np.ndarray = start) -> float:
            return 0.5 * float(np.sum(((x - start) / DECADES) ** 2)) - density(ys, *np.exp(x))

        best = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9}).x
        h = 0.02 * np.eye(2)
        H = [
            [(loss(best + a + b) - loss(best + a - b) - loss(best - a + b) + loss(best - a - b)) / 16e-4 for b in h]
            for a in h
        ]
        found[name] = best, np.array(H)
    return found


def objective_of(series: dict[str, np.ndarray]) -> tuple[Objective, list[int]]:
    log, folds = Log.of(WALKS), []
    for k, (name, ys) in enumerate(series.items()):
        log.add(name, np.arange(READINGS, dtype=float) + 0.1 * k, ys)
    tuning = Tuning.of(WALKS)
    entries, _ = entries_of("kf", tuning, [log], ("Q", "R"))
    held_out = np.zeros(log.n, bool)
    return (
        Objective(
            "kf", tuning, tuple(entries), (Recording(log, 1.0, held_out),), go=lambda done: not folds.append(done)
        ),
        folds,
    )


@pytest.fixture(scope="module")
def reached(series) -> tuple[Objective, np.ndarray, list[int]]:
    objective, folds = objective_of(series)
    x, _ = maximise(objective, objective.start)
    return objective, x, folds


def arranged(objective: Objective, theirs: dict[str, tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return their maximum (6,) and curvature (6, 6) in the order of the entries; of two walks it is zero."""
    keys = [item.key for item in objective.entries]
    best, H = np.zeros(len(keys)), np.zeros((len(keys), len(keys)))
    for name, (own, part) in theirs.items():
        at = [keys.index(f"Q.{name}"), keys.index(f"R.{name}")]
        best[at], H[np.ix_(at, at)] = own, part
    return best, H


def test_the_curvature_is_that_of_the_plain_likelihood_in_fewer_folds_than_all_pairs_take(reached, theirs):
    objective, x, folds = reached
    folds.clear()
    found = curvature(objective, x)
    cov = np.linalg.inv(arranged(objective, theirs)[1])
    # Differences over a deviation: the fourth derivative of a log-variance adds 1/12 of the squared deviation, 0.2².
    # An error of MAX_CORRELATION adds half a percent for each of the four other walks' entries.
    assert np.diag(found.cov) == pytest.approx(np.diag(cov), rel=0.05)
    correlation = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert np.abs(found.correlation - correlation).max() < MAX_CORRELATION
    # The centre, two points of each entry, and two of each pair of noises of one walk.
    assert sum(folds) == 1 + 2 * 6 + 2 * 3
    nearby = curvature(objective, x, np.linalg.inv(found.cov))
    assert sum(folds) == 2 * (1 + 2 * 6) + 2 * 3
    # From the correlations at the same point it is the same.
    assert nearby.cov == pytest.approx(found.cov, rel=1e-9, abs=1e-12)


DIFFUSE = 1e7
"""Variance of the first state, as in Durbin & Koopman, Time Series Analysis by State Space Methods (2012), 2.2.5."""


TREND = StateSpaceModel(
    name="trend",
    title="level with a slope",
    states=(State("level", "", 0.0, DIFFUSE**0.5), State("slope", "", 0.0, DIFFUSE**0.5)),
    noises=(Noise("level", "1/s", 1.0), Noise("slope", "1/s³", 0.1)),
    sensors=(Sensor("y", (Row("y", "", 1.0),), h=first_state),),
    f=constant_speed,
    linear=True,
)
NILE = level_model({"y": 10_000.0}, 3000.0, mean=0.0, std=DIFFUSE**0.5, linear=True)


def fitted_to(model: StateSpaceModel, ys: np.ndarray, factor: float = 1.0, **options: bool) -> Fitted:
    """Fit from variances that are the model's by a factor."""
    log, own = Log.of(model), Tuning.of(model)
    log.add("y", np.arange(ys.size, dtype=float), ys)
    return fit("kf", replace(own, q=factor * own.q, r=factor * own.r), [Recording(log)], blocks=0, **options)


def statsmodels_of(ys: np.ndarray, kind: str, start: tuple[float, ...], fixed: tuple[float, ...]) -> tuple:
    """Return the variances and the likelihood at the maximum by statsmodels, from the same prior."""
    model = sm.tsa.UnobservedComponents(ys, kind)
    model.loglikelihood_burn = 0
    model.ssm.initialize_known(np.zeros(model.k_states), DIFFUSE * np.eye(model.k_states))

    def loss(logs):
        return -float(model.loglike([*fixed, *np.exp(logs)], transformed=True))

    best = minimize(loss, np.log(start), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12})
    return np.exp(best.x), -best.fun


NILE_FLOW = sm.datasets.nile.load_pandas().data["volume"].to_numpy(float, copy=True)
LOG_GDP = 100.0 * np.log(sm.datasets.macrodata.load_pandas().data["realgdp"].to_numpy(float))


@pytest.fixture(scope="module")
def plain():
    return fitted_to(NILE, NILE_FLOW, penalised=False)


def test_the_trend_of_gdp_has_the_maximum_of_statsmodels_with_a_variance_at_its_lower_limit():
    """That of the irregular part, which tends to zero: it is not left alone, and ends at its range."""
    found = fitted_to(TREND, LOG_GDP, penalised=False)
    by_key = {line.key: line for line in found.lines}
    assert by_key["R.y"].edge and by_key["R.y"].after == 1e-4 and not any(line.alone for line in found.lines)
    variances, likelihood = statsmodels_of(LOG_GDP, "lltrend", (0.5, 0.05), fixed=(1e-4,))
    # The diffuse start costs seven digits of sixteen, so that the likelihood is known to 1e-8, its maximum to 1e-4.
    assert found.after.fitted.log_likelihood == pytest.approx(likelihood, abs=1e-6)
    assert [by_key[f"Q.{name}"].after for name in ("level", "slope")] == pytest.approx(variances, rel=1e-4)


def test_a_weak_prior_lowers_the_likelihood_and_is_reported(plain):
    assert not plain.penalised and plain.power == 1.0 and not any(line.alone or line.pull for line in plain.lines)
    found = fitted_to(NILE, NILE_FLOW, 100.0)
    assert found.penalised and found.after.fitted.log_likelihood < -641.5856
    # To first order the prior moves an estimate by what the result says.
    exact = {line.key: line.after for line in plain.lines}
    for line in found.lines:
        moved = np.log(line.after / exact[line.key]) / line.deviation
        assert abs(moved) > 0.05 and line.pull == pytest.approx(moved, rel=0.25), line
