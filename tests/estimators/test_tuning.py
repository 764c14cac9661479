"""The tuning: frozen, versioned, and one line for whatever is wrong."""

import json

import numpy as np
import pytest

from estimators.errors import ConfigError
from estimators.model.state_space import Parameter, StateSpaceModel
from estimators.models import MODELS
from estimators.tuning import Tuning
from tests.cases import cases
from tests.estimators.interpreted.test_filterpy import PENDULUM
from tests.support import error_of

MOTOR = MODELS["motor_winding"]


def test_of_is_what_the_model_declares():
    tuning = Tuning.of(PENDULUM)
    np.testing.assert_array_equal(tuning.q, [0.02, 0.05, 0.01])
    np.testing.assert_array_equal(tuning.r, [0.04, 0.09, 0.25])
    np.testing.assert_array_equal(tuning.p, [9.81])
    assert tuning.used.all()
    assert tuning.gate is None


def test_set_changes_one_entry_of_a_new_tuning():
    old = Tuning.of(PENDULUM)
    for key, value in (("Q.rate", 0.5), ("R.swing", 9.0), ("R.pair.b", 3.0), ("p.g", 1.62), ("gate", 0.99)):
        new = old.set(key, value)
        assert new.get(key) == value
        assert old.get(key) == Tuning.of(PENDULUM).get(key)
        assert new.version > old.version
        for other in old.keys():
            assert other == key or new.get(other) == old.get(other)
    held = old.set("use.pair", False)
    assert held.get("use.pair") is False
    assert old.get("use.pair") is True
    assert old.set("gate", 0.9).set("gate", None).gate is None


def test_versions_never_repeat():
    tuning = Tuning.of(MOTOR)
    versions = [tuning.version]
    for value in (1.0, 2.0, 1.0):
        tuning = tuning.set("R.winding", value)
        versions.append(tuning.version)
    assert versions == sorted(set(versions))
    assert tuning.with_options({"alpha": 0.5}).version > versions[-1]


@cases(__file__, "wrong_tunings.csv")
def test_what_is_wrong_is_one_line(key, value, says):
    assert says in error_of(ConfigError, Tuning.of(MOTOR).set, key, json.loads(value))


def test_a_parameter_stays_in_its_range():
    declared = {name: getattr(PENDULUM, name) for name in PENDULUM.__dataclass_fields__}
    model = StateSpaceModel(**{**declared, "parameters": (Parameter("g", "m/s²", 9.81, 1.0, 25.0),)})
    with pytest.raises(ConfigError, match=r"p\.g is 0.5 m/s²; it must lie between 1 and 25"):
        Tuning.of(model).set("p.g", 0.5)
    assert Tuning.of(model).set("p.g", 25.0).p[0] == 25.0


def test_items_name_units_of_variances():
    units = {item.key: item.unit for item in Tuning.of(MOTOR).items()}
    assert units == {"Q.temperature": "°C²/s", "Q.rate": "°C²/s³", "R.winding": "°C²"}
    car = {item.key: item.unit for item in Tuning.of(MODELS["road_car"]).items()}
    assert any(unit.startswith("(") and unit.endswith(")²") for unit in car.values())


def test_keys_are_all_settable():
    for model in MODELS.values():
        tuning = Tuning.of(model)
        assert len(set(tuning.keys())) == len(tuning.keys())
        for key in tuning.keys():
            if key != "gate":
                assert tuning.set(key, tuning.get(key)).get(key) == tuning.get(key)


def test_the_many_rows_of_a_sensor_are_one_entry_and_still_rows():
    model = MODELS["thermal_field"]
    tuning = Tuning.of(model)
    keys = [item.key for item in tuning.items()]
    assert [key for key in keys if key.startswith("R.")] == ["R.thermocouples"]
    assert tuning.get("R.thermocouples") == 0.25
    wide = tuning.set("R.thermocouples", 4.0)
    assert (wide.r == 4.0).all()
    one = wide.set("R.thermocouples.t10_30", 9.0)
    assert (one.r == 4.0).sum() == 99 and one.get("R.thermocouples.t10_30") == 9.0
    assert one.get("R.thermocouples") == pytest.approx(4.05)
    assert "R.thermocouples.t10_30" in tuning.keys() and "R.thermocouples" in tuning.keys()
    with pytest.raises(ConfigError, match="a variance must be positive"):
        tuning.set("R.thermocouples", 0.0)
    # Few rows keep an entry each.
    assert "R.gnss_position.east" in [item.key for item in Tuning.of(MODELS["road_car"]).items()]
