"""Errors that last, in a twin's YAML: what is appended, what is refused, and a simulation whose time is known."""

import numpy as np
import pytest

from app.twin.log_reader import read_log
from config.schema import json_schema
from estimators.diagnostics.score import score
from estimators.fold import fold
from estimators.forecast import forecast
from estimators.log import READING, truth_of
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import as_log, folded

pytestmark = pytest.mark.usefixtures("inside")

LASTING = """\
model: motor_winding
noise:
  temperature: {variance: 0.5, correlation_time: 40 s}
  rate: {variance: 0.001}
sensors:
  winding: {variance: 0.25, error: {std: 2, correlation_time: 5 min}}
estimator: kf
source: {type: simulator, seed: 1, step: 1.0, duration: 4000}
"""


def test_states_parameters_and_noises_are_appended():
    model = twin_of(LASTING).model
    assert [(state.name, state.unit) for state in model.states[2:]] == [
        ("temperature_disturbance", "°C/s"),
        ("winding_error", "°C"),
    ]
    # σ² = q/(2τ) of the disturbance.
    assert [state.std for state in model.states[2:]] == pytest.approx([np.sqrt(0.5 / 80.0), 2.0])
    assert [(item.name, item.value, item.low, item.high) for item in model.parameters] == [
        ("temperature_disturbance_time", 40.0, 0.4, 4000.0),
        ("winding_error_time", 300.0, 3.0, 30000.0),
    ]
    assert [(item.name, item.variance) for item in model.noises] == [
        ("temperature", 0.5), ("rate", 0.001), ("winding_error", 4.0)
    ]  # fmt: skip
    assert model.linear


def test_what_is_appended_may_be_named_wherever_a_state_or_a_parameter_may():
    text = LASTING + (
        "prior: {winding_error: {mean: 1, std: 3}}\nparameters: {winding_error_time: {std: 50, role: estimated}}\n"
        "valid_range: {winding_error: [-9, 9]}\nview: {pairs: [[temperature, winding_error]]}\n"
    )
    twin = twin_of(text.replace("kf", "ekf"))
    assert twin.model.state_names[-2:] == ("winding_error", "winding_error_time")
    error = twin.model.states[3]
    assert (error.mean, error.std, error.fitted) == (1.0, 3.0, (-9.0, 9.0))
    assert twin_of(LASTING, overrides={"p.winding_error_time": "60"}).tuning.get("p.winding_error_time") == 60.0
    assert (
        twin_of(LASTING, overrides={"noise.temperature.correlation_time": "2 min"}).model.parameters[0].value == 120.0
    )


@pytest.mark.parametrize(
    ("given", "seconds"), [("40", 40), ("40 s", 40), ("2.5 min", 150), ("1 h", 3600), ("500 ms", 0.5), ("1e-1 d", 8640)]
)
def test_a_time_may_have_a_unit(given, seconds):
    assert twin_of(LASTING.replace("40 s", given)).model.parameters[0].value == pytest.approx(seconds)


@cases(__file__, "lasting.csv")
def test_what_cannot_last_is_one_line_with_its_place(old, new, words):
    assert refusal(LASTING.replace(old, new)) == words


def test_a_field_has_no_lasting_error():
    field = "model: thermal_field\nnoise: {temperature: {std: 1, correlation_time: 9}}\nsource: {type: simulator}\n"
    assert refusal(field) == (
        "motor.yaml:2: noise.temperature.correlation_time: model thermal_field is a field, whose noise cannot have a "
        "correlation time"
    )


def test_the_schema_tells_editors_of_it():
    parts = json_schema()["$defs"]
    assert "Correlation time" in parts["NoiseSection"]["properties"]["correlation_time"]["description"]
    assert parts["ErrorSection"]["required"] == ["correlation_time"]
    kinds = {item.get("type") for item in parts["ErrorSection"]["properties"]["correlation_time"]["anyOf"]}
    assert kinds == {"number", "string"}


def test_a_simulation_whose_time_is_known_is_white_with_it_and_not_without():
    twin = twin_of(LASTING)
    log, _ = read_log(twin, None)
    rows, truth = truth_of(log.events, 2)
    n = truth.size
    assert n == 4000
    # The lag-20 correlation is exp(-20/40). Bartlett's standard error of a correlation of an AR(1) of n values with
    # φ = exp(-1/40) is √((1 + φ²)/(1 - φ²)/n) = 0.10 at most.
    lag = np.corrcoef(truth[20:], truth[:-20])[0, 1]
    assert lag == pytest.approx(np.exp(-0.5), abs=3 * 0.10)
    # Its variance is q/(2τ), within √(2 τ / n) = 14 % of itself: its square forgets in τ/2 on either side.
    assert np.var(truth) == pytest.approx(0.5 / 80.0, rel=3 * 0.14)
    track = fold("kf", twin.model, twin.tuning, log)
    result = score(track, log.events, twin.model)
    assert result.nis_low < result.nis < result.nis_high
    # White noise alone, over the readings: a truth of a temperature at each of them.
    white = twin_of(
        LASTING.replace(", correlation_time: 40 s", "").replace(", error: {std: 2, correlation_time: 5 min}", "")
    )
    readings = log.events.select(log.events.kind == READING)
    alone = as_log(readings._replace(value=readings.value[:, : white.model.width]))
    blind = fold("kf", white.model, white.tuning, alone)
    _, temperature = truth_of(log.events, 0)
    inside = np.abs(blind.mean[:, 0] - temperature) < 1.96 * blind.std[:, 0]
    # Nobody tells the error of the only sensor from the temperature: the band must say so. 4000 s hold 4000/600 errors
    # that are independent, so the share in the band is 0.95 ± 0.085.
    assert result.states["temperature"].coverage > 0.95 - 3 * 0.085 > 0.5 > inside.mean()
    assert result.log_likelihood > blind.log_likelihood.sum() + 100.0


def test_a_forecast_goes_on_from_what_lasts():
    """What a disturbance of now adds until then is τ (1 - e⁻ᵃ) of it."""
    twin = twin_of(LASTING)
    log, _ = read_log(twin, 100.0)
    made = folded("kf", twin.model, log, twin.tuning)
    x, now = made.track.mean[-1], int(log.t[log.n - 1])
    ahead = forecast("kf", twin.model, twin.tuning, made.base_here(), now, 60.0, 1.0).mean[-1]
    moved = x[0] + 60.0 * x[1] + 40.0 * (1.0 - np.exp(-60.0 / 40.0)) * x[2]
    np.testing.assert_allclose(ahead, [moved, x[1], x[2] * np.exp(-1.5), x[3] * np.exp(-0.2)], rtol=1e-9)
