"""Noise as a twin's YAML can say it: correlated rows, none at all, and that which comes with each reading."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.cli.arguments import FoldCommand as Arguments
from app.cli.fold import fold_twin
from app.engine.commands import SetEstimator, SetOption
from app.engine.execute import retuned
from app.engine.fold_json import tuning_from_json
from app.record.reader import read_recording
from app.twin.log_reader import read_log
from app.twin.twin import restore_twin
from estimators.errors import ConfigError, EstimatorError
from estimators.fold import fold
from estimators.log import READING, TRUTH, Log
from estimators.models import MODELS
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import measured

ROVER = """\
model: pair.py:Pair
sensors:
  fix: {std: [1, 2]}
prior:
  x: {mean: 1, std: 2}
estimator: kf
source:
  type: simulator
  duration: 400
"""

PAIR = """\
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    out[:] = x


def h(x, u, p, out):
    out[:] = x


def Pair():
    return StateSpaceModel(
        name="pair", title="Pair", states=(State("x", "m"), State("y", "m")), f=f, linear=True,
        noises=(Noise("x", "m²/s", 0.1), Noise("y", "m²/s", 0.1)),
        sensors=(Sensor("fix", (Row("east", "m", 1.0), Row("north", "m", 4.0)), h=h),),
    )
"""

TABLE = """\
model: motor_winding
estimator: kf
sensors:
  winding: {std: 2}
source:
  type: table
  files: run.csv
  time: {column: t}
  sensors:
    winding: {columns: w, accuracy: {std: a}}
"""


@pytest.fixture(autouse=True)
def _pair(inside):
    Path("pair.py").write_text(PAIR)


def correlated(matrix):
    return ROVER.replace("[1, 2]}", f"[1, 2], correlation: {matrix}}}")


def test_correlated_rows_make_a_full_r():
    """The first posterior of a prior N(m, P) at R = [[1, 1], [1, 4]], by the equations of the Kalman filter."""
    twin = twin_of(correlated("[[1, 0.5], [0.5, 1]]"))
    log = measured(twin.model, "fix", [0.0], [[3.0, -1.0]], start=0.0)
    track = fold("kf", twin.model, twin.tuning, log)
    m, P, R = np.array([1.0, 0.0]), np.diag([4.0, 1.0]), np.array([[1.0, 1.0], [1.0, 4.0]])
    K = P @ np.linalg.inv(P + R)
    np.testing.assert_allclose(track.mean[-1], m + K @ (np.array([3.0, -1.0]) - m), rtol=1e-12)
    np.testing.assert_allclose(track.std[-1], np.sqrt(np.diag(P - K @ P)), rtol=1e-12)


def test_the_simulated_sensor_is_correlated_too():
    """What is said less what is true, of 400 readings: the correlation within 5 standard errors, (1 - c²) / √n."""
    log, _ = read_log(twin_of(correlated("[[1, -0.9], [-0.9, 1]]")), None)
    events = log.events
    said, true = (events.value[events.kind == kind] for kind in (READING, TRUTH))
    c = np.corrcoef((said - true).T)[0, 1]
    assert len(said) == 400 and abs(c + 0.9) < 5 * (1 - 0.9**2) / np.sqrt(400)


@cases(__file__, "correlations.csv")
def test_a_correlation_that_is_none_is_one_line(matrix, expected):
    assert refusal(correlated(matrix)) == f"motor.yaml:3: sensors.fix.correlation {expected}"


def test_a_correlation_must_be_rows_of_numbers():
    with pytest.raises(ConfigError) as caught:
        twin_of(correlated("[1, 0.5]"))
    place = "motor.yaml:3: sensors.fix.correlation"
    assert str(caught.value) == f"{place}[0] is 1; it must be a list\n{place}[1] is 0.5; it must be a list"


def test_localisation_needs_rows_that_have_places_of_their_own():
    text = correlated("[[1, 0.5], [0.5, 1]]").replace("estimator: kf", "estimator: {name: enkf, options: {radius: 1}}")
    assert refusal(text).startswith("motor.yaml:6: estimator enkf: radius is 1, but the rows of pair's sensor fix are")


def test_the_identity_correlates_nothing():
    assert twin_of(correlated("[[1, 0], [0, 1]]").replace("estimator: kf", "estimator: pf")).model.correlated is None


def test_a_sensor_without_noise_and_a_state_that_is_certain():
    """x is known to be 1 at first and stays so, as it is not driven; y is what the sensor reads, exactly."""
    text = ROVER.replace("[1, 2]", "[1, 0]").replace("std: 2}", "std: 0}") + "noise:\n  x: {std: 0}\n"
    twin = twin_of(text)
    log = measured(twin.model, "fix", [0.0, 1.0], [[3.0, -1.0], [5.0, 2.5]], start=0.0)
    track = fold("kf", twin.model, twin.tuning, log)
    np.testing.assert_allclose(track.mean, [[1.0, -1.0], [1.0, 2.5]], atol=1e-12)
    np.testing.assert_allclose(track.std, 0.0, atol=1e-9)
    assert twin.tuning.set("R.fix.north", 4.0).set("R.fix.north", 0.0).get("R.fix.north") == 0.0


@pytest.mark.parametrize(("old", "new", "what"), [
    ("[1, 2]", "[1, 0]", "fix.north reads without noise"),
    ("std: 2}", "std: 0}", "x is certain at first"),
])  # fmt: skip
def test_a_filter_that_cannot_bear_certainty_says_what_can(old, new, what):
    text = ROVER.replace(old, new).replace("estimator: kf", "estimator: ukf")
    assert refusal(text) == (
        f"motor.yaml:6: estimator ukf does not apply: in pair {what}, and ukf takes no singular covariance; give it a "
        "small variance, or use kf, ekf, iekf, sr-kf, sr-ekf, sr-ukf"
    )


def test_a_simulated_sensor_may_be_exact():
    """The asset's own noise is 0, the estimator's is not."""
    twin = twin_of(ROVER + "  sensors: {fix: {std: 0}}\n")
    log, _ = read_log(twin, None)
    said, true = (log.events.value[log.events.kind == kind] for kind in (READING, TRUTH))
    np.testing.assert_array_equal(said, true)
    assert twin.tuning.get("R.fix.east") == 1.0


def test_a_field_must_be_uncertain():
    name = MODELS["field_era5"].states.name
    text = (
        f"model: field_era5\nestimator: enkf\nprior:\n  {name}: {{std: 0}}\nsource: {{type: simulator, duration: 1}}\n"
    )
    assert refusal(text) == (
        f"motor.yaml:4: prior.{name}.std is 0; that of a field must be positive, or its members would be alike"
    )


def test_a_log_likelihood_is_not_asked_about_readings_without_noise():
    """Only particle filters use it, and they refuse such a sensor; √0 in its denominator is nobody's fault."""
    likely = "def likely(y, x, u, p, r):\n    return -0.5 * (y[0] - x[0]) ** 2 / r[0]\n\n\n"
    pair = PAIR.replace("def Pair", likely + "def Pair").replace("h=h)", "h=h, log_likelihood=likely)")
    Path("pair.py").write_text(pair)
    twin = twin_of(ROVER.replace("[1, 2]", "[0, 2]"))
    log = measured(twin.model, "fix", [0.0], [[3.0, -1.0]], start=0.0)
    assert fold("kf", twin.model, twin.tuning, log).mean[-1, 0] == pytest.approx(3.0)


def test_a_reading_brings_its_own_noise_from_a_table():
    """As if a script had added each with its variance; 0 or none leaves the tuned R, an unknown one the value out."""
    accuracy = ["0.5", "", "3", "0", "-1", "1", "1.7e308", "inf", "bad", "NaN"]
    t, w = np.arange(1.0, 11.0), [21.0, 22.0, 20.0, 25.0, 24.0, 23.0, *[90.0] * 4]
    rows = "\n".join(f"{a:g},{b:g},{c}" for a, b, c in zip(t, w, accuracy, strict=True))
    Path("run.csv").write_text(f"t,w,a\n{rows}\n")
    twin = twin_of(TABLE)
    log, counts = read_log(twin, None)
    assert (counts["accuracy winding"], counts["unknown accuracy winding"]) == (2, 5)
    oracle = Log.of(twin.model)
    missing = [*w[:4], np.nan, w[5], *[np.nan] * 4]
    oracle.add("winding", t, missing, variance=[0.25, np.nan, 9.0, np.nan, np.nan, 1.0, *[np.nan] * 4])
    ours, theirs = (fold("kf", twin.model, twin.tuning, each) for each in (log, oracle))
    rows = log.events.kind == READING
    np.testing.assert_array_equal(ours.mean[rows], theirs.mean)
    np.testing.assert_array_equal(ours.std[rows], theirs.std)


@cases(__file__, "accuracies.csv")
def test_an_accuracy_that_cannot_be_used_is_one_line(old, new, expected):
    assert old in TABLE
    assert refusal(TABLE.replace(old, new)) == expected


def test_what_readings_bring_is_recorded_and_folded_again():
    """A recording has the variances; the fold of them is the one that was recorded, and not that of the tuned R."""
    Path("run.csv").write_text("t,w,a\n1,40,0.5\n2,42,\n3,41,3\n")
    Path("motor.yaml").write_text(TABLE)
    assert fold_twin(Arguments("motor.yaml", out=Path("run.rrd"))) == 0
    recorded = read_recording(Path("run.rrd"))
    twin = restore_twin(recorded.text, recorded.twin_path)
    np.testing.assert_array_equal(recorded.events.value[:, twin.model.width], [0.25, np.nan, 9.0])
    log = Log.of(twin.model)
    log.extend(recorded.events)
    tuning, estimator = tuning_from_json(recorded.tuning, twin.model)
    again, direct = (
        fold(estimator, twin.model, tuning, log),
        fold("kf", twin.model, twin.tuning, read_log(twin, None)[0]),
    )
    np.testing.assert_array_equal(again.std, direct.std)
    # P⁺ = P r / (P + r) at once, of the first reading; its prior has the variance 25.
    assert again.std[0, 0] == pytest.approx(np.sqrt(25 * 0.25 / 25.25), rel=1e-12)


def test_a_filter_of_one_r_is_refused_before_readings_bring_theirs():
    """On the page too, where the first of them may be yet to come; then the twin would stand still."""
    twin = twin_of(TABLE)
    engine: Any = SimpleNamespace(
        twin=twin, model=twin.model, estimator="kf", tuning=twin.tuning, options_of=twin.options_of
    )
    for command, reason in (
        (SetEstimator("kf-steady"), "its gain is for one R; use kf"),
        (SetOption("adapt", 1.0), "adapt learns one R of each sensor; set adapt to off or Q"),
    ):
        with pytest.raises(EstimatorError, match=f"readings bring their own variance, but {reason}"):
            retuned(command, engine)
    assert retuned(SetOption("adapt", 2.0), engine)[1].options["adapt"] == 2.0


@pytest.mark.parametrize("word", ["stratified", "2"])
def test_options_that_are_choices_may_be_words(word):
    from estimators import ESTIMATORS

    option = next(item for item in ESTIMATORS["pf"].options if item.name == "resampling")
    code = float(option.choices.index(word)) if word in option.choices else float(word)
    text = ROVER.replace("estimator: kf", f"estimator: {{name: pf, options: {{resampling: {word}}}}}")
    twin = twin_of(text + "filters: {kf: {adapt: R, joseph: off}}\n")
    assert twin.tuning.options == {"resampling": code} == twin.options_of("pf")
    assert twin.options_of("kf") == {"adapt": 1.0, "joseph": 0.0}
    over = twin_of(ROVER, overrides={"estimator": "pf", "estimator.options.resampling": word})
    assert over.tuning.options == {"resampling": code}


def test_a_word_that_is_no_choice_is_one_line():
    text = ROVER.replace("estimator: kf", "estimator: {name: kf, options: {adapt: sometimes}}")
    assert refusal(text) == "motor.yaml:6: estimator kf: adapt is 'sometimes'; it must be one of off, R, Q"
    # YAML's own words of a switch: off is one of the choices.
    text = ROVER.replace("estimator: kf", "estimator: {name: kf, options: {adapt: false}}")
    assert twin_of(text).tuning.options == {"adapt": 0.0}
    assert refusal(text.replace("false", "true")).endswith("adapt is 'on'; it must be one of off, R, Q")
    text = ROVER.replace("estimator: kf", "estimator: {name: kf, options: {inflation: R}}")
    assert refusal(text) == "motor.yaml:6: estimator kf: inflation is 'R'; it must be a number"
