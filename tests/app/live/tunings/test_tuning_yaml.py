"""The settings of a run as YAML: pasted in place of the file's own sections, the twin starts with the same settings."""

import numpy as np
import pytest
import yaml

from app.live.tunings.tuning_yaml import tuning_yaml
from app.twin.twin import load_twin, restore_twin
from estimators.registry import ESTIMATORS

SECTIONS = ("estimator", "filters", "parameters", "noise", "sensors", "gate")


def pasted(twin, text):
    """The twin of a file that has these sections in place of its own."""
    given, own = yaml.safe_load(text), yaml.safe_load(twin.text)
    assert set(given) <= set(SECTIONS)
    rest = yaml.safe_dump({key: value for key, value in own.items() if key not in SECTIONS})
    return restore_twin(f"{text}{rest}", twin.path)


def same(a, b):
    for name in ("q", "r", "p", "used"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    return (a.gate, a.gate_kind, a.reopen) == (b.gate, b.gate_kind, b.reopen)


@pytest.mark.parametrize(
    "name", ["motor_can", "motor_winding", "motor_bench_joint", "agv_corridor", "thermal_field", "road_car"]
)
def test_a_twin_as_it_is_comes_back(name):
    twin = load_twin(name)
    back = pasted(twin, tuning_yaml(twin.config, twin.estimator, twin.tuning))
    assert back.estimator == twin.estimator and same(back.tuning, twin.tuning)
    for other in ESTIMATORS:
        assert back.options_of(other) == twin.options_of(other)


def test_limits_of_a_sensor_stay_with_it():
    given = {"sensors.yoke.range": "[-40, 180]", "sensors.yoke.rate": "5"}
    twin = load_twin("motor_can", overrides=given)
    back = pasted(twin, tuning_yaml(twin.config, "ekf", twin.tuning.set("R.yoke", 2.0)))
    yoke, before = back.config.sensors["yoke"], twin.config.sensors["yoke"]
    assert (yoke.range, yoke.rate) == (before.range, before.rate) and yoke.range is not None
    assert back.tuning.get("R.yoke") == 2.0


def test_what_was_turned_comes_back():
    twin = load_twin("motor_can")
    tuning = twin.tuning.set("Q.winding", 1e-7).set("R.yoke", 0.1 + 0.2).set("use.tooth", False).set("gate", 0.99)
    tuning = tuning.set("gate.kind", "soft").set("gate.reopen", None).set("p.iron_magnet", 0.31)
    tuning = tuning.with_options({"adapt": 1.0, "memory": 50.0})
    text = tuning_yaml(twin.config, "ekf", tuning)
    back = pasted(twin, text)
    assert same(back.tuning, tuning)
    entry = ESTIMATORS["ekf"]
    assert entry.complete(dict(back.tuning.options)) == entry.complete(dict(tuning.options))
    assert "adapt: R" in text and "use: false" in text and "reopen: never" in text


def test_options_of_the_first_filter_are_kept_for_another():
    twin = load_twin("motor_can", overrides={"estimator": "{name: enkf, options: {members: 77}}"})
    text = tuning_yaml(twin.config, "ukf", twin.tuning.with_options({"alpha": 0.5}))
    back = pasted(twin, text)
    assert back.estimator == "ukf" and back.options_of("ukf") == {"alpha": 0.5}
    assert back.options_of("enkf") == {"members": 77.0}


def test_no_gate_is_said():
    twin = load_twin("motor_can")
    back = pasted(twin, tuning_yaml(twin.config, "ekf", twin.tuning.set("gate", None)))
    assert back.tuning.gate is None


def test_how_long_errors_last_stands_beside_their_size():
    given = {"noise.winding": "{variance: 0.01, over: 2 min}", "sensors.yoke.error": "{std: 0.7, over: 40}"}
    twin = load_twin("motor_can", overrides=given)
    assert same(pasted(twin, tuning_yaml(twin.config, "ekf", twin.tuning)).tuning, twin.tuning)
    tuning = twin.tuning.set("p.winding_disturbance_time", 33.3).set("p.yoke_error_time", 11.0)
    tuning = tuning.set("Q.yoke_error", 0.1 + 0.2).set("Q.winding", 0.003)
    text = tuning_yaml(twin.config, "ekf", tuning)
    assert same(pasted(twin, text).tuning, tuning) and "_time" not in text
    # A correlation time that is estimated has no place in the tuning: the file's stays.
    twin = load_twin("motor_can", overrides={**given, "estimate.winding_disturbance_time": "{std: 30}"})
    assert "over: 120}" in tuning_yaml(twin.config, "ekf", twin.tuning)
