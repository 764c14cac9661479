"""Experiments whose figures are published (docs/published.md): twin experiments, and series of textbooks."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import statsmodels.api as sm
from statsmodels.tsa.statespace.tests.results.results_kalman_filter import uc_uni

from estimators import Log, fold
from estimators.compiled.model import compile_model
from estimators.diagnostics.innovations import jarque_bera, ljung_box
from estimators.model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models.lorenz import LORENZ63, LORENZ96
from tests.estimators.fit.test_search import NILE, NILE_FLOW, TREND, fitted_to

Figures = dict[str, Any]


class Chaos(NamedTuple):
    """Twin experiment as in a script of DAPPER, with all states measured."""

    model: StateSpaceModel
    mean: np.ndarray
    variance: float
    steps: int
    spin_up: int


CHAOS = {
    "lorenz63": Chaos(LORENZ63, LORENZ63.prior_mean, 2.0, 25, 64),
    "lorenz96": Chaos(LORENZ96, np.eye(40)[0], 0.001, 1, 400),
}


def simulate(chaos: Chaos, cycles: int, seed: int) -> tuple[np.ndarray, Log]:
    """Return the true states (cycles, nx), which start at a draw of the prior, and measurements of all of them."""
    model, rng = chaos.model, np.random.default_rng(seed)
    f, p = compile_model(model).f, model.default_parameters
    states = np.empty((cycles * chaos.steps + 1, model.nx))
    states[0] = rng.normal(chaos.mean, chaos.variance**0.5)
    for before, after in zip(states[:-1], states[1:], strict=True):
        f(before, np.zeros(0), p, model.max_step, after)
    truth, log = states[chaos.steps :: chaos.steps], Log.of(model, start=0.0)
    t = chaos.steps * model.max_step * np.arange(1, cycles + 1)
    log.add(model.sensor_names[0], t, rng.normal(truth, model.sensors[0].rows[0].variance ** 0.5))
    return truth, log


MACRO = sm.datasets.macrodata.load_pandas().data
SERIES = {
    "nile": NILE_FLOW,
    "unemployment": MACRO["unemp"].to_numpy(float),
    "consumption": np.diff(MACRO["realcons"].to_numpy(float)),
    "step": np.r_[10.2394, np.ones(9)],
    "bend": np.r_[10.2394, 4.2039, 6.123123, np.ones(7)],
}


def structural(
    series: str, observed: float, level: float, slope: float | None = None, prior: float = 1e6, gaps: Any = ()
) -> Figures:
    """A local level, or with `slope` a local linear trend, at given variances; years or quarters are seconds.

    The likelihood and the tests leave out as many values as the prior leaves states unknown: one or two.
    """
    ys, log, skipped = SERIES[series].copy(), Log.of(TREND), 1 if slope is None else 2
    for begin, end in gaps:
        ys[begin:end] = np.nan
    log.add("y", np.arange(ys.size, dtype=float), ys)
    start = np.zeros(2), prior * np.diag([1.0, skipped - 1.0])
    variances: Any = {"R": {"y": observed}, "Q": {"level": level, "slope": slope or 0.0}}
    filtered, smoothed = (
        fold("kf", TREND, log, prior=start, covariance=True, smoothed=each, **variances) for each in (False, True)
    )
    track = filtered.track
    z = (track.innovation / track.innovation_std)[skipped:, 0]
    return {
        "log-likelihood": np.nansum(track.log_likelihood[skipped:]),
        "filtered level": filtered.mean[:, 0],
        "filtered variance": filtered.cov[:, 0, 0],
        "smoothed level": smoothed.mean[:, 0],
        "smoothed slope": smoothed.mean[:, 1],
        "smoothed variance": smoothed.cov[:, 0, 0],
        "Ljung-Box statistic": [ljung_box(z, lags).statistic for lags in range(1, 11)],
        "Jarque-Bera statistic": jarque_bera(z).statistic,
    }


def fitted(std: float) -> Figures:
    """Maximum likelihood of a local level of the Nile, of which the first has the standard deviation `std`."""
    found = fitted_to(replace(NILE, states=(State("level", "", std=std),)), NILE_FLOW, penalised=False)
    return {line.key: line.after for line in found.lines} | {"log-likelihood": found.after.fitted.log_likelihood}


def moved(x, u, p, dt, out):
    out[0] = x[0] + x[3]
    out[1] = p[0] * x[1] + p[1] * x[2]
    out[2] = x[1]
    out[3] = x[3]


def trend_and_cycle(x, u, p, out):
    out[0] = x[0] + x[1]


def clark() -> Figures:
    """Clark's model of American output, at the published parameters, without the first 20 quarters."""
    *stds, phi_1, phi_2 = uc_uni["parameters"]
    model = StateSpaceModel(
        name="clark",
        title="trend and cycle of output",
        states=tuple(State(name, "", std=10.0) for name in ("trend", "cycle", "before", "drift")),
        parameters=(Parameter("phi_1", "", phi_1), Parameter("phi_2", "", phi_2)),
        noises=tuple(Noise(name, "", std**2) for name, std in zip(("trend", "cycle", "drift"), stds, strict=True)),
        sensors=(Sensor("output", (Row("output", "", 1e-20),), h=trend_and_cycle),),
        f=moved,
        linear=True,
    )
    ys, log = np.log(uc_uni["data"]), Log.of(model, start=0.0)
    log.add("output", np.arange(1.0, ys.size + 1.0), ys)
    run = fold("kf", model, log)
    rows = run.readings("output")[uc_uni["start"] :]
    trend, cycle, _, drift = run.mean[rows].T
    likelihood = run.track.log_likelihood[rows].sum()
    return {"log-likelihood": likelihood, "trend": trend, "cycle": cycle, "drift": drift}
