"""Names and notations of the version before: read with one line, and rewritten by `nisus migrate`."""

import logging

import pytest

from config import old_names
from config.loader import load
from config.old_names import new_key, new_overrides, read_yaml, rewrite, rewritten
from config.yaml_files import parse
from estimators.errors import ConfigError
from tests.cases import cases
from tests.support import error_of

OLD = """model: battery_cell           # a cell
prior: {soc: {mean: 0.5, std: 0.1}}
valid:                         # where it holds
  temperature: {min: 20, max: 38.0, extrapolate: 5}
  current: {
    max: 6                     # A
  }
possible: {soc: {min: 0, max: 1}}
noise: {v1: {variance: {value: 1e-3, from: 1e-4}, over: 2 min}}
sensors:
  voltage:
    std:
      value: 0.5               # measured
      from: 0.3
      to: 0.8                  # by its data sheet
    error: {std: 0.02, over: 3 s}
time: {horizon: 0.5, tick: 0.05}
source:
  type: merged
  parts:
  - type: table
    files: a.csv
    time: {column: t}
    sensors: {voltage: {columns: u, where: {ok: {min: 1}, flag: Good}, only: {tag: {min: 3, max: 4}}}}
  - &part
    type: table
    files: b.csv
    time: {column: t}
    inputs: {current: {columns: i, where: &where {ok: {max: 2}}}, air: {columns: a, where: *where}}
view: {"at": 12}
"""

NEW = """model: battery_cell           # a cell
prior: {soc: {mean: 0.5, std: 0.1}}
valid_range:                         # where it holds
  temperature: {range: [20, 38.0], extrapolate: 5}
  current: [null, 6]
                         # A

possible: {soc: [0, 1]}
noise: {v1: {variance: {value: 1e-3, range: [1e-4, null]}, correlation_time: 2 min}}
sensors:
  voltage:
    std:
      {value: 0.5, range: [0.3, 0.8]}               # measured

                  # by its data sheet
    error: {std: 0.02, correlation_time: 3 s}
time: {max_delay: 0.5, predict_every: 0.05}
source:
  type: merged
  parts:
  - type: table
    files: a.csv
    time: {column: t}
    sensors: {voltage: {columns: u, valid_if: {ok: [1, null], flag: Good}, only: {tag: [3, 4]}}}
  - &part
    type: table
    files: b.csv
    time: {column: t}
    inputs: {current: {columns: i, valid_if: &where {ok: [null, 2]}}, air: {columns: a, valid_if: *where}}
view: {cursor: 12}
"""


def loaded(tmp_path, text, **overrides):
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return load(path, {key.replace("__", "."): value for key, value in overrides.items()})


def test_the_text_of_the_version_before_becomes_that_of_this_one_with_its_comments():
    assert rewritten(OLD) == NEW and rewritten(NEW) == NEW
    values = "{range: [1, 2]}", "[1, 2]", "{value: 3, range: [null, 4]}"
    assert [rewritten(text) for text in values] == list(values)


def test_a_twin_of_the_version_before_is_that_of_this_one_and_one_line_names_what_changed(tmp_path, caplog):
    old_names._tell.cache_clear()
    with caplog.at_level(logging.WARNING, "nisus"):
        old, new = loaded(tmp_path, OLD), loaded(tmp_path, NEW)
        loaded(tmp_path, OLD)
    assert old.config == new.config and old.text == NEW
    assert old.places.at(("time", "max_delay")) == f"{tmp_path / 'cell.yaml'}:17"
    (line,) = caplog.messages
    assert line.startswith(f"{tmp_path / 'cell.yaml'}: valid (line 3) is valid_range now, ")
    assert line.endswith(f"an interval is [low, high] now; `nisus migrate {tmp_path / 'cell.yaml'}` rewrites it")


JOINT = """model: battery_cell
estimate:
  r0: {std: 0.005, drift: 1e-6}  # ohm
  r1:
    std: 0.01
source: {type: push}
"""


def test_what_was_estimated_is_the_role_of_a_parameter(tmp_path):
    new = JOINT.replace("estimate:", "parameters:").replace("1e-6}", "1e-6, role: estimated}")
    new = new.replace("0.01\n", "0.01\n    role: estimated\n")
    assert rewritten(JOINT) == new
    alone = loaded(tmp_path, JOINT).config.parameters
    assert alone == loaded(tmp_path, new).config.parameters and alone["r0"].role == alone["r1"].role == "estimated"
    # Beside a section of parameters the text stays; the values are the same.
    both = loaded(tmp_path, JOINT + "parameters: {r1: {value: 0.03}, r0: 0.02}\n")
    assert both.text.startswith(JOINT) and both.places.by_hand
    given = {name: item.model_dump(exclude_unset=True) for name, item in both.config.parameters.items()}
    assert given["r0"] == {"value": 0.02, "std": 0.005, "drift": 1e-6, "role": "estimated"}
    assert given["r1"] == {"value": 0.03, "std": 0.01, "role": "estimated"}
    wrong = error_of(ConfigError, loaded, tmp_path, JOINT.replace("0.01", "-1"))
    assert wrong == f"{tmp_path / 'cell.yaml'}:5: parameters.r1.std is -1; it must be positive"
    given = loaded(tmp_path, JOINT, **new_overrides({"estimate.r2.std": "0.1"})).config.parameters
    assert (given["r2"].std, given["r2"].role, given["r0"].role) == (0.1, "estimated", "estimated")


@cases(__file__, "shared_parts.csv")
def test_data_are_renamed_where_the_text_cannot_be(tmp_path, old, new, rewrites):
    """Aliases and `<<` may share what is renamed with what is not: the data count, and migrate leaves such a file."""
    text, data, places = read_yaml(old, "cell.yaml")
    assert {name: item for name, item in data.items() if not name.startswith("x-")} == parse(new, "")[0]
    assert places.by_hand == (not rewrites) and text == (rewrites or old)
    if places.by_hand:
        (tmp_path / "cell.yaml").write_text(old)
        assert error_of(ConfigError, rewrite, tmp_path / "cell.yaml", str).endswith(old_names.BY_HAND)
        assert [path.name for path in tmp_path.iterdir()] == ["cell.yaml"]


@cases(__file__, "two_names.csv")
def test_what_is_given_by_two_names_is_refused(text, error):
    assert error_of(ConfigError, read_yaml, text, "cell.yaml") == error


def test_a_value_of_the_command_line_by_two_names_is_refused():
    given = {"time.horizon": "2", "time.max_delay": "3"}
    assert "time.max_delay is given twice" in error_of(ConfigError, new_overrides, given)
    assert "--set parameters.NAME.std=0.1" in error_of(ConfigError, new_overrides, {"estimate.r1": "0.01"})


@cases(__file__, "old_keys.csv")
def test_a_key_of_the_version_before_is_one_of_this_one_where_it_was_one(old, new):
    assert ".".join(new_key(tuple(old.split(".")))) == new


def test_what_is_no_mapping_of_the_version_before_loses_nothing():
    bomb = "a: &a0 {b: 1}\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))
    nested = "[" * 2000, "&a [*a]", "{[1]: 2}", bomb
    wrong = "valid: {soc: {min: 0, mox: 1}}", "learned: {file: a}", "valid: [", "noise: {a: {over: {b: 1}}}"
    for text in (*wrong, *nested):
        new = rewritten(text)
        assert sorted(new.replace("valid_range", "valid").replace("correlation_time", "over")) == sorted(text)


@pytest.mark.parametrize("head", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_file_is_rewritten_whole_whatever_its_lines_end_with(tmp_path, head, end):
    path = tmp_path / "cell.yaml"
    path.write_text(head + OLD.replace("\n", end), encoding="utf-8", newline="")
    kept = rewrite(path, lambda text: text)
    assert path.read_bytes().decode() == NEW.replace("\n", end)
    assert kept.read_bytes().decode() == head + OLD.replace("\n", end)
