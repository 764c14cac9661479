"""The search and the curvature at its end against a plain Kalman likelihood in NumPy, maximised by SciPy."""

import numpy as np
import pytest
from scipy.optimize import minimize

from estimators.fit.entries import entries_of
from estimators.fit.objective import Objective, maximise
from estimators.fit.recording import Recording
from estimators.fit.uncertainty import MAX_CORRELATION, curvature
from estimators.log import Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.models import first_state, second_state

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
