"""The gate in a twin's YAML: a probability, null, or what becomes of readings beyond it."""

from pathlib import Path

import pytest

from app.twin.twin import restore_twin
from config.loader import load_text
from estimators.errors import ConfigError
from estimators.tuning import REOPEN_S

TWIN = "model: motor_winding\nsource: {type: simulator}\ngate: "


def loaded(gate):
    return load_text(TWIN + gate, Path("motor.yaml")).config.gate


def test_a_number_is_a_hard_gate_that_reopens():
    assert loaded("null") is None
    assert loaded("0.99") == loaded("{probability: 0.99}")
    assert (loaded("0.99").kind, loaded("0.99").seconds) == ("hard", REOPEN_S)


def test_all_that_a_gate_may_be():
    gate = loaded("{probability: 0.999, kind: soft, reopen: 5}")
    assert (gate.probability, gate.kind, gate.seconds) == (0.999, "soft", 5.0)
    assert loaded("{probability: 0.999, reopen: never}").seconds is None


def test_it_reaches_the_tuning():
    tuning = restore_twin(TWIN + "{probability: 0.999, kind: soft, reopen: never}", "motor.yaml").tuning
    assert [tuning.get(key) for key in ("gate", "gate.kind", "gate.reopen")] == [0.999, "soft", None]


@pytest.mark.parametrize(
    ("gate", "overrides", "expected"),
    [
        ("0.999", {"gate.kind": "soft"}, (0.999, "soft", 30.0)),
        ("0.999", {"gate.reopen": "never", "gate": "0.99"}, (0.99, "hard", None)),
        ("{probability: 0.9, kind: soft}", {"gate.probability": "0.95"}, (0.95, "soft", 30.0)),
        ("null", {"gate.probability": "0.95", "gate.kind": "soft"}, (0.95, "soft", 30.0)),
    ],
)
def test_a_part_of_a_gate_is_overridden_also_where_the_file_has_a_number(gate, overrides, expected):
    found = load_text(TWIN + gate, Path("motor.yaml"), overrides).config.gate
    assert (found.probability, found.kind, found.seconds) == expected


@pytest.mark.parametrize(
    ("gate", "rule"),
    [
        ("2", "motor.yaml:3: gate is 2; it must be below 1"),
        ("{probability: 2}", "motor.yaml:3: gate.probability is 2; it must be below 1"),
        ("{kind: soft}", "motor.yaml:3: gate.probability is missing; add it"),
        ("{probability: 0.9, kind: mild}", "motor.yaml:3: gate.kind is 'mild'; it must be 'hard' or 'soft'"),
        ("{probability: 0.9, open: 3}", "motor.yaml:3: gate.open is not known"),
    ],
)
def test_one_clear_line(gate, rule):
    with pytest.raises(ConfigError) as caught:
        loaded(gate)
    assert str(caught.value).startswith(rule)
