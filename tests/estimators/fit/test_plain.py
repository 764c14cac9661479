"""Maximum likelihood without a prior against statsmodels with the same start; the published Nile: tests/textbook.py."""

from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from scipy.optimize import minimize

from estimators.fit.fit import Fitted, fit
from estimators.fit.recording import Recording
from estimators.log import Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.models import constant_speed, first_state, level_model

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


def theirs(ys: np.ndarray, kind: str, start: tuple[float, ...], fixed: tuple[float, ...]) -> tuple:
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
    variances, likelihood = theirs(LOG_GDP, "lltrend", (0.5, 0.05), fixed=(1e-4,))
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
