"""Fields: names, places and what a track shows of them; noise with a shape; a plate that keeps its heat."""

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.diagnostics.score import score
from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold
from estimators.log import READING, TRUTH
from estimators.model.state_space import LARGE, Field, Noise, Row, Sensor, StateSpaceModel
from estimators.models.thermal_field import thermal_field
from estimators.numerics.smoothed_noise import smooth
from estimators.tuning import Tuning
from sources.simulator import Simulator
from tests.models import first_state, unchanged
from tests.support import as_log, folded, log_of, read_all


def test_cells_have_names_places_and_a_prior():
    field = Field("t", "K", (3, 4), spacing=(2.0, 0.5), periodic=(False, True), mean=5.0, std=2.0)
    assert len(field) == 12
    cell = field[6]
    assert (cell.name, cell.unit, cell.mean, cell.std, cell.position) == ("t[1,2]", "K", 5.0, 2.0, (2.0, 1.0))
    assert field[-1].name == "t[2,3]"
    assert [field.index_of(state.name) for state in field] == list(range(12))
    np.testing.assert_array_equal(field.positions(), [state.position for state in field])
    assert field.periods == (np.inf, 2.0)
    for name in ("t[3,0]", "t[0]", "u[0,0]", "t"):
        with pytest.raises(ValueError, match="not a cell of t"):
            field.index_of(name)
    with pytest.raises(ModelError, match="means has 2 entries; give 12"):
        Field("t", "K", (3, 4), means=(1.0, 2.0))


def test_a_track_shows_all_of_a_small_model_and_probes_of_a_large_one():
    assert thermal_field(6, 8, 2).shown.tolist() == list(range(48))
    model = thermal_field(50, 50, 2)
    assert model.shown.size == len(model.shown_states) == 16
    assert model.states[int(model.shown[3])] == model.shown_states[3]
    assert "temperature[49,49]" in model.state_names and "temperature[50,0]" not in model.state_names


@pytest.mark.parametrize(("rows", "columns", "down", "across"), [(5, 7, 0.6, 0.3), (1, 9, 0.5, 0.9), (4, 1, 0.2, 0.7)])
def test_smoothed_noise_has_the_correlation_it_says(rows, columns, down, across):
    """L from the unit vectors; L Lᵀ against the formula, at the edges too."""
    n = rows * columns
    L = np.empty((n, n))
    for k, unit in enumerate(np.eye(n)):
        out = np.empty(n)
        smooth(unit, rows, columns, down, across, out)
        L[:, k] = out
    i, j = np.divmod(np.arange(n), columns)
    expected = down ** np.abs(i[:, None] - i) * across ** np.abs(j[:, None] - j)
    np.testing.assert_allclose(L @ L.T, expected, rtol=0, atol=1e-13)


def test_an_insulated_plate_keeps_its_heat_and_relaxes_to_its_mean():
    model = thermal_field(9, 13, 2)
    f = compile_model(model).f
    T = 20 + np.random.default_rng(0).standard_normal(117)
    u, out = np.array([0.05, 0.05, 20.0]), np.empty(117)
    p = np.array([2.4e-5, 1e18, 0.0, 0.05])
    before = T.copy()
    for _ in range(2000):
        f(T, u, p, 1.0, out)
        T = out.copy()
    assert T.mean() == pytest.approx(before.mean(), rel=1e-12)
    assert T.std() < 1e-6 * before.std()  # the slowest mode decays as exp(-0.014 t)
    p[2] = 2.0
    f(before, u, p, 1.0, out)
    warmed = out.copy()
    p[2] = 0.0
    f(before, u, p, 1.0, out)
    heat = (warmed - out).reshape(9, 13)
    assert heat[5, 5] == pytest.approx(2.0)
    assert heat[0, 5] == pytest.approx(2.0 * np.exp(-0.5))


def test_a_field_is_folded_and_scored_by_its_shown_cells():
    """A plate of 1600 cells: simulated, told of 16 cells, and estimated with variances instead of a covariance."""
    model = thermal_field(40, 40, 4)
    assert model.nx > LARGE
    source = Simulator(model, seed=1, step=1.0, duration=20)
    log = as_log(read_all(source))
    events = log.events
    told = np.unique(events.channel[events.kind == TRUTH])
    assert told.tolist() == model.shown.tolist()
    tuning = Tuning.of(model).with_options({"members": 30, "radius": 0.3})
    fold = folded("ensrf", model, log, tuning)
    mean, variances = fold.moments()
    X = fold._now.state[: 30 * model.nx].reshape(30, model.nx)
    np.testing.assert_allclose(mean, X.mean(0), rtol=1e-12)
    np.testing.assert_allclose(variances, X.var(0, ddof=1)[None], rtol=1e-9)
    np.testing.assert_allclose(fold.track.std[-1], np.sqrt(variances[0, model.shown]), rtol=1e-9)
    result = score(fold.track, events, model)
    assert list(result.states) == [state.name for state in model.shown_states]
    # 16 readings of variance 0.25 a second hold the error well below the prior's deviation of 1 °C.
    assert np.mean([fit.rmse for fit in result.states.values()]) < 0.7
    assert np.mean([fit.coverage for fit in result.states.values()]) > 0.75
    with pytest.raises(EstimatorError, match="1,600 states needs a 0.0205 GB covariance"):
        Fold("ekf", model, Tuning.of(model), log)


def test_forecast_noise_has_the_models_shape():
    """10 000 members of a plate at rest after one second: covariance q dt L Lᵀ + prior, within five sigma."""
    model = thermal_field(4, 5, 1)
    log = log_of(model.width, (0, READING, np.nan), (1, READING, np.nan))
    tuning = Tuning.of(model).set("p.diffusivity", 0.0).set("p.relaxation", 1e6).set("p.heating", 0.0)
    fold = folded("etkf", model, log, tuning.set("Q.temperature", 3.0).with_options({"members": 10_000}))
    i, j = np.divmod(np.arange(20), 5)
    distance = np.abs(i[:, None] - i) + np.abs(j[:, None] - j)
    expected = 4.0 * np.exp(-0.1 * distance)
    error = np.abs(fold.moments()[1] - expected)
    assert error.max() < 5 * 4.0 * np.sqrt(2 / 10_000)


def test_what_a_large_field_cannot_have_is_refused():
    def Q(x, u, p, q, dt, out):
        out[:] = 0

    common = dict(title="", sensors=(Sensor("s", (Row("s", "K", 1.0),), h=first_state),), f=unchanged)
    field = Field("t", "K", (50, 50))
    with pytest.raises(ModelError, match="Q of 2,500 states would be a matrix of 0.05 GB"):
        StateSpaceModel(name="m", states=field, noises=(Noise("t", "K²/s", 1.0),), Q=Q, **common)
    with pytest.raises(ModelError, match="noise 'u' is not a state or field"):
        StateSpaceModel(name="m", states=field, noises=(Noise("u", "K²/s", 1.0),), **common)
