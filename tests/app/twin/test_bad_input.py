"""What no filter can run with is refused in one line, or gives way visibly, by whatever way it comes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from app.cli.main import main
from app.engine import commands
from app.engine.execute import playback
from app.twin.twin import load_twin, restore_twin
from app.web.commands_json import command_from_json
from estimators.compiled.model import compile_model
from estimators.errors import ConfigError, ModelError, NisusError
from estimators.fold import fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.registry import ESTIMATORS, unfit
from estimators.track import FAILED, GATED, USED
from estimators.tuning import Tuning
from tests import ROOT
from tests.app.scripted import Replayed, Stepped, pull_all
from tests.cases import cases
from tests.models import first_state, unchanged
from tests.support import SECOND, error_of

PATH = ROOT / "config" / "twins" / "motor_winding.yaml"


def reading(model, second, values):
    return Events.one(round(second * SECOND), round(second * SECOND), READING, 0, values, model.width)


def one_line(text, expected):
    assert expected in text and "\n" not in text and "Traceback" not in text


@pytest.mark.parametrize("way", ["yaml", "filters", "set", "api", "page"])
@cases(__file__, "bad_options.csv")
def test_an_option_that_cannot_be_is_one_line_and_changes_nothing(name, option, number, expected, way):
    value, place = float(number), ""
    stepped = Stepped(of=load_twin("motor_winding", overrides={"estimator": name}))
    stepped.put(reading(stepped.engine.model, 1.0, [40.0]))
    before = stepped.status()
    with pytest.raises(NisusError) as caught:
        if way == "set":
            place = f"--set estimator.options.{option}={value}: "
            load_twin("motor_winding", overrides={"estimator": name, f"estimator.options.{option}": str(value)})
        elif way == "api":
            command_from_json({"command": "SetOption", "name": option, "value": value}, stepped.engine)
        elif way == "page":
            # As a page that asks without the API's checks.
            stepped.submit(commands.SetOption(option, value))
        else:
            text, line = with_option(way, name, option, value)
            place = f"motor_winding.yaml:{line}: "
            restore_twin(text, PATH)
    one_line(str(caught.value), expected)
    assert place in str(caught.value)
    status = stepped.status()
    assert (status.estimator, status.options, status.revision) == (before.estimator, before.options, 0)
    stepped.put(reading(stepped.engine.model, 2.0, [41.0]))
    assert pull_all(stepped.engine).track.verdict[1] == USED


def with_option(way, name, option, value):
    """The twin's YAML with one option of a filter, of the first one or of another, and the line where it stands."""
    head, tail = PATH.read_text().split("\nestimator: kf")
    first = f"\nestimator:\n  name: {name}\n  options:\n    {option}: {value}"
    other = f"\nestimator: kf\nfilters:\n  {name}:\n    {option}: {value}"
    head += first if way == "yaml" else other
    return head + tail[tail.index("\ngate:") :], head.count("\n") + 1


@pytest.mark.parametrize("value", ["abc", "inf", None, [1], {}])
def test_an_option_that_is_no_number_is_refused_by_the_api(value):
    engine = Stepped(of=load_twin("motor_winding", overrides={"estimator": "ukf"})).engine
    text = error_of(NisusError, command_from_json, {"command": "SetOption", "name": "alpha", "value": value}, engine)
    one_line(text, "alpha" if isinstance(value, str) else "value")


BEYOND = "1" + "0" * 400
"""More than a float can hold."""


@cases(__file__, "too_large.csv")
def test_a_number_beyond_all_numbers_is_refused_with_its_place_and_rule(way, value, expected):
    value = value.replace("BEYOND", BEYOND)
    with pytest.raises(ConfigError) as caught:
        if way == "api":
            engine = Stepped(of=load_twin("motor_winding")).engine
            command_from_json({"command": "SetTuning", "key": "Q.temperature", "value": json.loads(value)}, engine)
        elif way == "set":
            load_twin("motor_winding", overrides={"Q.temperature": value})
        else:
            restore_twin(PATH.read_text().replace("variance: 0.01}", f"variance: {value}}}"), PATH)
    one_line(str(caught.value), expected)
    assert len(str(caught.value)) < 200


def test_a_choice_may_be_given_as_its_word():
    stepped = Stepped(of=load_twin("motor_winding", overrides={"estimator": "ekf"}))
    stepped.submit(command_from_json({"command": "SetOption", "name": "robust", "value": "huber"}, stepped.engine))
    assert stepped.status().options["robust"] == 1.0


def test_a_covariance_that_is_none_is_refused_when_the_model_loads():
    def Q(x, u, p, q, dt, out):
        out[0, 0] = q[0] * dt
        out[1, 1] = q[0] * dt
        out[0, 1] = 2.0 * q[0] * dt
        out[1, 0] = 2.0 * q[0] * dt

    model = StateSpaceModel(
        name="crossed", title="Crossed", f=unchanged, Q=Q, states=(State("a", "m", 0, 1), State("b", "m", 0, 1)),
        noises=(Noise("a", "m²/s", 0.5),), sensors=(Sensor("a", (Row("a", "m", 1.0),), first_state),),
    )  # fmt: skip
    with pytest.raises(
        ModelError, match=r"Q is not positive semidefinite \(it has the eigenvalue -0.5\) at the prior; a cov"
    ):
        compile_model(model)


@pytest.mark.parametrize("spike", [1e9, -1e12, 1e155, 1e300, -1e300])
@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_a_spike_is_gated_and_leaves_no_trace(name, spike):
    """Whatever its size, and the others see the same: three rows at once, of which one is mad."""
    model = MODELS["motor_winding"] if unfit(ESTIMATORS[name], MODELS["lorenz63"]) else MODELS["lorenz63"]
    options = {option.name: 50.0 for option in ESTIMATORS[name].options if option.name in ("particles", "members")}
    tuning = Tuning.of(model).set("gate", 0.9973).with_options(options)
    sound = model.prior_mean[: model.ny]
    mad = np.where(np.arange(model.ny) == 0, spike, sound)
    log = Log(model.width)
    for k, values in enumerate((sound, mad, sound, sound), start=1):
        log.extend(reading(model, 0.01 * k, values))
    track = fold(name, model, tuning, log)
    assert track.verdict.tolist() == [USED, GATED, USED, USED]
    assert np.isfinite(track.mean).all() and np.isfinite(track.std).all()
    assert track.innovation[1, 0] == pytest.approx(spike, rel=1e-6)


@pytest.mark.parametrize("name", ["pf", "pf-reg", "pf-ekf", "apf"])
def test_particles_that_all_weigh_nothing_recover_and_it_is_said(name):
    """Without a gate: the square of such a residual is beyond the numbers, so every density is zero."""
    stepped = Stepped(of=load_twin("motor_winding", overrides={"estimator": name}))
    for second, value in enumerate([40.0, 1e200, 41.0, 40.5, 39.5], start=1):
        stepped.put(reading(stepped.engine.model, second, [value]))
    track, counts = pull_all(stepped.engine).track, stepped.status().counts
    assert track.verdict.tolist() == [USED, FAILED, USED, USED, USED]
    assert np.isfinite(track.mean).all() and abs(track.mean[-1, 0] - 40.0) < 5.0
    assert (counts["recovered"], counts["failed"]) == (1, 1)
    text = f"{name}: no particle explained a reading; the cloud was widened, 1 time(s) so far"
    assert text in stepped.notices()


@pytest.mark.parametrize("seconds", [1e300, -1e300, np.inf])
def test_a_seek_beyond_all_time_is_refused(seconds):
    source = SimpleNamespace(seek=lambda t: None, span=(0, SECOND))
    with pytest.raises(ConfigError, match="must lie within 1e\\+09 s"):
        playback(source, commands.Seek(seconds), 0)


@pytest.mark.parametrize("factor", [1e300, 1.1e9, 0.0, -1.0, -np.inf, np.nan])
def test_a_speed_that_no_clock_can_follow_is_refused(factor):
    speeds = []
    source = Replayed()
    source.set_speed = speeds.append
    with pytest.raises(ConfigError, match=r"Speed: factor is .* must be positive and at most 1e\+09, or inf"):
        playback(source, commands.Speed(factor), 0)
    for good in (1e-3, 1e9, np.inf):
        playback(source, commands.Speed(good), 0)()
    assert speeds == [1e-3, 1e9, np.inf]


@pytest.mark.parametrize("speed", ["1e300", "0", "nan"])
def test_a_speed_on_the_command_line_is_held_to_the_same(speed, capsys):
    assert main(["run", "motor_winding", "--headless", "--speed", speed]) == 2
    assert "must be positive and at most 1e+09" in capsys.readouterr().err
