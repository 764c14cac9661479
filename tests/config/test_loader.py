import json
import os
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.twin.twin import restore_twin
from config.loader import find, load, load_text, moved, shipped
from config.source_schema import CanSection, SimulatorSection
from config.yaml_files import as_flow, as_section, parse
from estimators.errors import ConfigError
from estimators.tuning import REOPEN_S
from tests.cases import cases
from tests.support import error_of

MOTOR = """\
model: motor_winding
noise:
  temperature: {variance: 1e-3}
sensors:
  winding:
    std: 2
estimator: kf
gate: 0.9973
source:
  type: simulator
  duration: 120
  inputs:
    torque: [1, {steps: [[0, 1], [5, 2]]}]
"""


def message(text, overrides=None):
    with pytest.raises(ConfigError) as caught:
        load_text(text, Path("motor.yaml"), overrides)
    return str(caught.value)


def test_values_are_read_and_defaults_filled_in():
    loaded = load_text(MOTOR, Path("folder/motor.yaml"))
    config = loaded.config
    assert config.name == "motor"
    assert config.noise["temperature"].value == 1e-3
    assert config.sensors["winding"].variances == (4.0,)
    assert config.sensors["winding"].use is True
    assert config.estimator.name == "kf" and config.estimator.options == {}
    assert config.history == 200_000 and config.time.max_delay == 2.0
    assert config.source.type == "simulator" and config.source.duration == 120.0
    assert [profile.constant for profile in config.source.inputs["torque"]] == [1.0, None]
    assert config.source.inputs["torque"][1].steps == ((0.0, 1.0), (5.0, 2.0))
    assert loaded.text == MOTOR
    assert loaded.places.at(("sensors", "winding", "std")) == "folder/motor.yaml:6"
    assert loaded.places.at(("source", "inputs", "torque", 1)) == "folder/motor.yaml:13"


def test_every_duration_takes_a_unit():
    set_to = {
        "time.predict_every": "500 ms",
        "time.stale_after": "2 min",
        "time.max_delay": "0.5 s",
        "view.window": "1 h",
    }
    config = load_text(MOTOR.replace("duration: 120", "duration: 1 d"), Path("motor.yaml"), set_to).config
    assert (config.time.predict_every, config.time.stale_after, config.time.max_delay) == (0.5, 120.0, 0.5)
    assert (config.view.window, config.source.duration) == (3600.0, 86400.0)


@cases(__file__, "mistakes.csv")
def test_a_value_that_breaks_a_rule_is_one_line(old, new, expected):
    assert old in MOTOR
    assert message(MOTOR.replace(old, new, 1)) == expected


def test_a_missing_type_is_told_those_of_the_schema(monkeypatch):
    untyped = MOTOR.replace("  type: simulator\n", "")
    known = "motor.yaml:9: source.type is missing; it must be one of simulator, can"
    assert message(untyped).startswith(f"{known}, can_log, table")
    monkeypatch.setattr("config.problems.SourceSection", Annotated[SimulatorSection | CanSection, "two of them"])
    assert message(untyped) == known


@cases(__file__, "no_twins.csv")
def test_what_is_not_a_twin_at_all_is_one_line(text, expected):
    assert message(text) == expected


def test_a_text_too_deep_or_with_characters_that_are_none_is_one_line(request):
    # Libraries raise Python's limit.
    request.addfinalizer(partial(sys.setrecursionlimit, sys.getrecursionlimit()))
    sys.setrecursionlimit(1000)
    assert message("[" * 5000) == "motor.yaml:1: it is nested too deeply; a twin needs six levels"
    said = "motor.yaml:2: the character '\\x01' is not text; remove it"
    assert message("model: a\ntitle: '\x01'\n") == said


def test_one_mistake_is_one_line_though_it_breaks_several_rules():
    text = MOTOR.replace("    std: 2", "    std: [-1]").replace("[1, {steps: [[0, 1], [5, 2]]}]", "{a: 1}")
    assert message(text).splitlines() == [
        "motor.yaml:6: sensors.winding.std[0] is -1; it must be zero or positive",
        "motor.yaml:13: source.inputs.torque.a is not known; choose from constant, steps, repeat, sine",
    ]
    text = "model: a\nsource: {type: can, interface: virtual, channel: [1], dbc: a.dbc}\n"
    assert message(text) == "motor.yaml:2: source.channel is [1]; it must be a whole number"


def test_nested_aliases_cannot_ask_for_billions_of_values():
    text = "a: &a [x, x, x, x, x, x, x, x, x, x]\n"
    for old, new in zip("abcdefghi", "bcdefghij", strict=True):
        text += f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n"
    assert message(text).endswith("it holds more than 100000 values; are its aliases (*name) meant?")


def test_several_problems_are_a_line_each_and_no_more_than_five():
    text = MOTOR.replace("    std: 2", "    std: -2").replace("gate: 0.9973", "gate: 2")
    assert message(text).splitlines() == [
        "motor.yaml:6: sensors.winding.std is -2; it must be zero or positive",
        "motor.yaml:8: gate is 2; it must be below 1",
    ]
    noise = "".join(f"  n{k}: {{variance: -1}}\n" for k in range(8))
    lines = message(MOTOR.replace("  temperature: {variance: 1e-3}\n", noise)).splitlines()
    assert len(lines) == 6 and lines[-1] == "motor.yaml: and 3 more"


def test_words_that_yaml_1_1_takes_for_booleans_are_names():
    text = MOTOR.replace("  winding:", "  no: {use: false}\n  on:")
    assert list(load_text(text, Path("motor.yaml")).config.sensors) == ["no", "on"]


@pytest.mark.parametrize(
    ("text", "value"), [("1e-3", 1e-3), ("010", 10.0), (".5", 0.5), ("2_000", 2000.0), ("5.", 5.0)]
)
def test_numbers_are_read_as_people_write_them(text, value):
    assert load_text(MOTOR.replace("120", text), Path("motor.yaml")).config.source.duration == value


def test_a_section_left_empty_means_its_defaults():
    text = MOTOR + "time:\n  # predict_every: 1\nview:\n"
    assert load_text(text, Path("motor.yaml")).config.time.predict_every == 0.5


def test_overrides_replace_values_and_errors_name_the_option():
    loaded = load_text(
        MOTOR, Path("motor.yaml"), {"source.duration": "5", "time.predict_every": "1e-1", "gate": "null"}
    )
    assert (
        loaded.config.source.duration == 5.0 and loaded.config.time.predict_every == 0.1 and loaded.config.gate is None
    )
    said = message(MOTOR, {"time.tock.x": "5"})
    assert said.startswith("--set time.tock.x=5: time.tock is not known; choose from max_delay, ")


@cases(__file__, "refused_overrides.csv")
def test_an_override_that_breaks_a_rule_is_one_line(key, value, said):
    assert message(MOTOR, {key: value}) == f"--set {key}={value}: {said}"


def test_files_that_cannot_be_read_are_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "binary.yaml").write_bytes(b"a: 1\n\x89PNG\xff")
    for name, said in (
        ("absent.yaml", "absent.yaml: there is no such file; check the path, or see `nisus twins`"),
        ("folder.yaml", "folder.yaml: it is a folder; give the YAML file in it"),
        ("binary.yaml", "binary.yaml:2: it is not UTF-8 text; is this the YAML file?"),
    ):
        assert error_of(ConfigError, load, name) == said
    text = error_of(ConfigError, load, "motor_windng")
    assert text.startswith("motor_windng: no twin of that name ships; did you mean motor_winding")
    assert text.endswith(", give a YAML file's path, or write one with `nisus new motor_windng`")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_refused_and_never_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ConfigError, match="it is a pipe or a device, which may never end; give a file"):
        load(str(tmp_path / "pipe.yaml"))


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    path = tmp_path / "motor.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + MOTOR.replace("\n", "\r\n").encode())
    loaded = load(path)
    assert loaded.config.model == "motor_winding" and loaded.text.startswith("model")
    assert loaded.places.at(("gate",)).endswith("motor.yaml:8")


def test_every_twin_that_ships_loads_by_name():
    assert "motor_winding" in shipped()
    for name in shipped():
        loaded = load(name)
        assert loaded.config.name == name
        assert find(name).name == f"{name}.yaml"
        assert loaded.text.startswith("#"), f"{name} must open with its source and what to expect"


TWIN = "model: motor_winding\nsource: {type: simulator}\ngate: "


def loaded(gate):
    return load_text(TWIN + gate, Path("motor.yaml")).config.gate


def test_a_gate_is_a_number_or_all_that_it_may_be():
    assert loaded("null") is None
    assert loaded("0.99") == loaded("{probability: 0.99}")
    assert (loaded("0.99").kind, loaded("0.99").seconds) == ("hard", REOPEN_S)
    gate = loaded("{probability: 0.999, kind: soft, reopen: 5}")
    assert (gate.probability, gate.kind, gate.seconds) == (0.999, "soft", 5.0)
    assert loaded("{probability: 0.999, reopen: never}").seconds is None


def test_it_reaches_the_tuning():
    tuning = restore_twin(TWIN + "{probability: 0.999, kind: soft, reopen: never}", "motor.yaml").tuning
    assert [tuning.get(key) for key in ("gate", "gate.kind", "gate.reopen")] == [0.999, "soft", None]


@cases(__file__, "gates.csv")
def test_a_part_of_a_gate_is_overridden_also_where_the_file_has_a_number(gate, overrides, probability, kind, seconds):
    found = load_text(TWIN + gate, Path("motor.yaml"), json.loads(overrides)).config.gate
    assert [str(given) for given in (found.probability, found.kind, found.seconds)] == [probability, kind, seconds]


@cases(__file__, "refused_gates.csv")
def test_one_clear_line(gate, rule):
    assert message(TWIN + gate).startswith(rule)


SHARED = """\
x-slow: &slow {variance: 4, use: false}
x-list: [1, *slow]
model: motor_winding
sensors:
  winding: *slow
  yoke: {<<: *slow, variance: 9}
source: {type: simulator}
"""


def test_anchors_stand_under_keys_that_begin_with_x():
    sensors = load_text(SHARED, Path("motor.yaml")).config.sensors
    assert [(name, one.variance, one.use) for name, one in sensors.items()] == [
        ("winding", (4.0,), False),
        ("yoke", (9.0,), False),
    ]
    assert message(SHARED.replace("x-list", "y-list")).startswith("motor.yaml:2: y-list is not known; ")
    assert message(SHARED.replace("<<: *slow", "<<: 5")).startswith("motor.yaml:6: sensors.yoke.<< must name mappings")


PLACES = """\
model: ./{0}pump.py:Pump         # comments stay
correction: {0}net.yaml
source:
  type: merged
  parts:
  - {{type: table, files: [{0}a.csv, {0}dir/*.csv, /data/b.csv], time: {{column: t}}}}
  - type: can_log
    files: {0}c.blf
    dbc: [{0}car.dbc, {{file: {0}gnss.dbc, channel: 2}}]
  - {{type: table, folder: {0}logs, files: d.csv, time: {{column: t}}}}
"""


@pytest.mark.parametrize(("out", "back"), [("copy.yaml", ""), ("sub/copy.yaml", "../"), ("../copy.yaml", "here/")])
def test_relative_paths_of_a_copy_name_the_same_files(tmp_path, out, back):
    (tmp_path / "here" / "sub").mkdir(parents=True)
    (text,) = {moved(PLACES.format(""), tmp_path / "here" / "twin.yaml", tmp_path / "here" / out)}
    expected = parse(PLACES.format(back), "a.yaml")[0]
    if back:  # no leading dot is needed
        expected["model"] = expected["model"].removeprefix("./")
        assert "# comments stay" in text
    assert parse(text, "a.yaml")[0] == expected
    shared = PLACES.format("").replace("correction: net", "x-net: &net net.yaml\ncorrection: *net #")
    if back:
        with pytest.raises(ConfigError, match="twin.yaml: an alias shares correction with another key; write the path"):
            moved(shared, tmp_path / "here" / "twin.yaml", tmp_path / "here" / out)


NAMES = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1, max_size=12)
NUMBERS = st.integers(-(10**12), 10**12) | st.floats(allow_nan=False, allow_infinity=False)
LEAVES = st.none() | st.booleans() | NUMBERS | NAMES
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4))


@settings(deadline=None)
@given(VALUES)
def test_a_value_is_read_back_as_it_was_written(value):
    data, _ = parse(as_flow(value), "a.yaml")
    assert data == value


@settings(deadline=None)
@given(st.dictionaries(NAMES, NUMBERS, min_size=1, max_size=6))
def test_a_section_has_a_line_for_each_entry(items):
    data, places = parse("\n".join(as_section("noise", items)), "a.yaml")
    assert data == {"noise": items}
    assert [places.at(("noise", name)) for name in items] == [f"a.yaml:{k + 2}" for k in range(len(items))]
