"""What a twin's YAML says is in its model and its tuning; what it cannot say, and models that fail, are one line."""

import os
from pathlib import Path

import numpy as np
import pytest

from app.twin.tuning_yaml import tuning_yaml
from app.twin.twin import load_twin, restore_twin
from config import extensions
from config.loader import TWINS
from estimators import errors
from estimators.compiled.model import compile_model
from estimators.errors import ConfigError, ModelError
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import error_of

pytestmark = pytest.mark.usefixtures("inside")

MOTOR = """\
model: motor_winding
prior:
  temperature: {mean: 30, std: 4}
noise:
  rate: {std: 0.1}
sensors:
  winding: {std: 3}
estimator: kf
gate: 0.99
view:
  pairs: [[rate, temperature]]
source:
  type: simulator
  duration: 120
  initial: {rate: 0.2}
"""

PUMP = """\
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    out[0] = 0.9 * x[0]


def h(x, u, p, out):
    out[0] = x[0]


def Pump():
    return StateSpaceModel(
        name="pump", title="Pump", states=(State("level", "m"),), noises=(Noise("level", "m²/s", 0.1),),
        sensors=(Sensor("level", (Row("level", "m", 0.01),), h=h),), f=f,
    )
"""


def test_the_yaml_sets_the_model_and_the_tuning_up():
    twin = twin_of(MOTOR + "title: My motor\n")
    assert [(state.mean, state.std) for state in twin.model.states] == [(30.0, 4.0), (0.0, 1.0)]
    np.testing.assert_allclose(twin.tuning.q, [0.01, 0.01])
    np.testing.assert_allclose(twin.tuning.r, [9.0])
    assert twin.tuning.gate == 0.99 and twin.tuning.used.tolist() == [True]
    assert twin.estimator == "kf" and twin.title == "My motor" and twin.name == "motor"
    assert twin.pairs.tolist() == [[1, 0]]


def test_a_sensor_that_is_not_used_is_held_out():
    assert twin_of(MOTOR.replace("{std: 3}", "{use: false}")).tuning.used.tolist() == [False]


def test_overrides_set_the_tuning_and_the_yaml():
    twin = twin_of(
        MOTOR,
        overrides={
            "Q.temperature": "2e-2",
            "R.winding": "5",
            "use.winding": "false",
            "gate": "null",
            "source.seed": "9",
        },
    )
    assert twin.tuning.get("Q.temperature") == 0.02 and twin.tuning.get("R.winding") == 5.0
    assert twin.tuning.get("use.winding") is False and twin.tuning.gate is None
    assert twin.config.source.seed == 9
    assert twin.text == MOTOR


@cases(__file__, "overrides.csv")
def test_an_override_that_breaks_a_rule_is_one_line(key, value, expected):
    assert refusal(MOTOR, overrides={key: value}) == expected


def test_an_unknown_override_names_what_is_near():
    text = refusal(MOTOR, overrides={"Q.temprature": "1"})
    said = "Q.temprature is not a tuning key of motor_winding; did you mean Q.temperature"
    assert text.startswith(f"--set Q.temprature=1: {said}")
    assert "; or a key of the YAML: name, title, teaches" in text and "\n" not in text


@cases(__file__, "lacks.csv")
def test_what_the_model_lacks_is_one_line_with_what_is_near(old, new, expected):
    assert old in MOTOR
    text = refusal(MOTOR.replace(old, new, 1))
    assert text.startswith(expected) if expected.endswith(" ") else text == expected


def test_a_parameter_out_of_its_range_is_one_line():
    text = PUMP.replace("Noise, Row", "Noise, Parameter, Row")
    Path("pump.py").write_text(
        text.replace("f=f,", 'f=f, parameters=(Parameter("area", "m²", 1.0, low=0.5, high=2.0),),')
    )
    yaml = "model: ./pump.py:Pump\nparameters:\n  area: 3\nsource: {type: simulator}\n"
    assert refusal(yaml) == "motor.yaml:3: parameters.area is 3 m²; it must lie between 0.5 and 2"


def test_a_model_from_a_file_beside_the_yaml(monkeypatch):
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    Path("twins").mkdir()
    Path("twins/pump.py").write_text(PUMP)
    Path("twins/pump.yaml").write_text("model: ./pump.py:Pump\nsource: {type: simulator}\n")
    twin = load_twin("twins/pump.yaml")
    assert twin.model.name == "pump" and twin.pairs.shape == (0, 2)
    compiled = compile_model(twin.model)
    out = np.zeros(1)
    compiled.f(np.array([2.0]), np.zeros(0), np.zeros(0), 1.0, out)
    assert out[0] == pytest.approx(1.8)
    assert sorted(os.listdir("twins")) == ["pump.py", "pump.yaml"], "loading leaves nothing beside the user's files"
    Path("twins/pump.py").write_text(PUMP.replace("0.9", "0.8"))
    compile_model(load_twin("twins/pump.yaml").model).f(np.array([2.0]), np.zeros(0), np.zeros(0), 1.0, out)
    assert out[0] == pytest.approx(1.6), "an edited file is read again"


def test_a_correction_without_its_extension_is_one_line(monkeypatch):
    monkeypatch.setattr(extensions, "registered", lambda kind: {})
    text = refusal("model: motor_winding\ncorrection: no.yaml\nsource: {type: simulator}\n")
    assert text.startswith(
        "motor.yaml:2: correction: needs an extension; install it with `pip install 'nisus[learned]'`"
    )


@cases(__file__, "failing_models.csv")
def test_a_model_file_that_fails_is_one_line_in_the_users_code(python, reference, kind, expected):
    Path("pump.py").write_text(python.replace("PUMP", PUMP).replace("NUL", "\0"))
    text = refusal(f"model: {reference}\nsource: {{type: simulator}}\n", getattr(errors, kind))
    assert text.startswith(expected) if expected.endswith(" ") else text == expected


def test_a_model_whose_shapes_disagree_is_refused_when_compiled():
    Path("pump.py").write_text(PUMP.replace("out[0] = 0.9 * x[0]", "out[0] = x[0] + x[1]"))
    twin = twin_of("model: ./pump.py:Pump\nsource: {type: simulator}\n")
    assert error_of(ModelError, compile_model, twin.model).startswith("pump.py:5: model pump: ")


def test_a_twin_is_restored_from_its_text_alone():
    Path("pump.py").write_text(PUMP)
    text = "model: ./pump.py:Pump\nsensors: {level: {std: 0.5}}\nsource: {type: simulator}\n"
    twin = restore_twin(text, "gone.yaml", {"Q.level": "0.3"})
    assert twin.model.sensors[0].rows[0].variance == 0.25 and twin.tuning.get("Q.level") == 0.3
    assert twin.name == "gone" and twin.text == text


def test_a_parameter_to_estimate_becomes_a_state_that_the_yaml_may_name():
    text = (
        "model: motor_drive\nparameters: {yoke_coolant: 0.04}\nestimate:\n  yoke_coolant: {std: 0.01, drift: 0.001}\n"
        "prior: {yoke_coolant: {std: 0.02}}\nview: {pairs: [[yoke, yoke_coolant]]}\n"
        "source: {type: simulator, duration: 10, initial: {yoke_coolant: 0.05}}\n"
    )
    model = twin_of(text).model
    assert model.states[-1].name == "yoke_coolant"
    assert (model.states[-1].mean, model.states[-1].std) == (0.04, 0.02)
    assert model.noises[-1].variance == pytest.approx(1e-6)
    with pytest.raises(ConfigError, match="motor.yaml:4: .*yoke_coolnt is no parameter of motor_drive; did you mean"):
        twin_of(text.replace("  yoke_coolant: {std", "  yoke_coolnt: {std"))


def test_a_filter_given_by_name_takes_options(tmp_path):
    """`estimator: ekf` in the YAML, or --estimator, and its options each by a --set of their own, in any order."""
    for name, given in [("battery_panasonic", {}), ("motor_winding", {"estimator": "ekf"}), ("lorenz63", {})]:
        overrides = {"estimator.options.inflation": "1.25", **given}
        made = load_twin(name, overrides=overrides)
        assert made.tuning.options["inflation"] == 1.25
        assert made.estimator == given.get("estimator", load_twin(name).estimator)


def test_a_filter_named_anew_keeps_what_the_yaml_gives_it():
    """Its own one named again runs with its options; another takes its place, and finds them when it comes back."""
    text = MOTOR.replace(
        "estimator: kf\n", "estimator: {name: ukf, options: {alpha: 0.5}}\nfilters: {ukf: {beta: 1}}\n"
    )
    own = twin_of(text)
    assert own.tuning.options == {"alpha": 0.5, "beta": 1.0}
    for key in ("estimator", "estimator.name"):
        again = twin_of(text, overrides={key: "ukf"})
        assert (again.estimator, again.tuning.options) == ("ukf", own.tuning.options), key
        other = twin_of(text, overrides={key: "iekf"})
        assert (other.estimator, other.tuning.options) == ("iekf", {}), key
        assert other.options_of("ukf") == own.options_of("ukf") == own.tuning.options, key
    more = twin_of(text, overrides={"estimator": "ukf", "estimator.options.alpha": "0.7"})
    assert more.tuning.options == {"alpha": 0.7, "beta": 1.0}
    with pytest.raises(ConfigError, match=r"^motor.yaml:8: .*alpha is 90"):
        twin_of(text.replace("alpha: 0.5", "alpha: 90"), overrides={"estimator": "iekf"})


def test_the_prior_of_what_is_considered_is_that_of_the_parameter():
    text = "model: motor_drive\nparameters: {yoke_coolant: {std: 10 %}}\nsource: {type: simulator}\n"
    twin = twin_of(text)
    assert twin.model.states[-1].name == "yoke_coolant_deviation"
    mean, cov = twin.model.prior_mean, twin.model.prior_cov
    written = tuning_yaml(twin.config, twin.estimator, twin.tuning, (mean, cov), whole=True)
    assert "winding: {mean" in written and "yoke_coolant_deviation" not in written


def test_a_fitted_prior_ends_where_the_state_does():
    twin = twin_of("model: battery_cell\nsource: {type: simulator}\n")
    beyond = (twin.model.prior_mean + [0.502, 0.0, 0.0], twin.model.prior_cov)
    assert "soc: {mean: 1, std: 0.3}" in tuning_yaml(twin.config, twin.estimator, twin.tuning, beyond)


@cases(__file__, "refused.csv")
def test_what_cannot_be_meant_is_refused(model, section, said):
    assert said in refusal(f"model: {model}\n{section}\nsource: {{type: simulator}}\n")


def test_a_width_is_added_to_a_parameter_given_as_a_number():
    text = "model: motor_drive\nparameters: {yoke_coolant: 0.04}\nsource: {type: simulator}\n"
    twin = twin_of(text, overrides={"parameters.yoke_coolant.std": "10 %"})
    assert twin.model.state_names[-1] == "yoke_coolant_deviation" and twin.model.considered == 1
    assert twin.model.prior_std[-1] == pytest.approx(0.1 * 0.04, rel=1e-12)


def test_offsets_and_scales_are_parameters_of_the_instruments():
    drive = MOTOR.replace("motor_winding", "motor_drive").replace("estimator: kf\n", "")
    drive = drive[: drive.index("prior:")] + (
        "sensors:\n  winding: {offset: {std: 0.5}, scale: {value: 1.01, std: 0.2 %}}\n  tooth: {offset: 0.3}\n"
        "inputs:\n  coolant: {offset: {std: 2, role: estimated, drift: 0.1}}\n"
        "parameters: {winding_offset: 0.1, tooth_offset: {std: 0.4, role: held}}\nsource: {type: simulator}\n"
    )
    model = twin_of(drive).model
    own = {item.name: item.value for item in model.parameters}
    assert (own["winding_offset"], own["winding_scale"], own["tooth_offset"]) == (0.1, 1.01, 0.3)
    assert model.considered == 2 and "coolant_offset" not in own
    last = {state.name: (state.mean, state.std) for state in model.states[4:]}
    assert last == {
        "coolant_offset": (0.0, 2.0),
        "winding_scale_deviation": (0.0, pytest.approx(0.00202)),
        "winding_offset_deviation": (0.0, 0.5),
    }


def test_an_offset_leaves_a_linear_model_to_the_kalman_filter():
    assert twin_of(MOTOR.replace("{std: 3}", "{std: 3, offset: {std: 0.5}}")).model.linear


JOINT = (TWINS / "motor_joint.yaml").read_text()


def section_of(text):
    return twin_of(f"{JOINT}\nrefit:\n{text}").config.refit


def test_durations_and_a_lone_entry():
    section = section_of("  entries: p.copper_resistance\n  every: 10 min\n  window: 0.5 h\n")
    assert (section.entries, section.every, section.window) == (("p.copper_resistance",), 600.0, 1800.0)
    assert section.adopt == "by hand"
    section = section_of(
        "  entries: [R, Q.winding, options.inflation]\n  every: 60\n  window: 60\n  adopt: if better\n"
    )
    assert section.adopt == "if better"


@cases(__file__, "refits.csv")
def test_what_is_refused_has_its_line(section, said):
    text = refusal(f"{JOINT}\nrefit:\n{section}")
    assert said in text and "motor.yaml:" in text
