"""Refused commands are answered in one line with value, rule and remedy, in terms of JSON."""

import dataclasses
import math
import typing

import pytest

from app.live import commands
from app.live.engine import Engine
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from estimators.errors import NisusError

KINDS = typing.get_args(commands.Command)
ODD = (
    "x", "", None, True, -1, 0, 0.5, math.nan, math.inf, 1e300, 10**400, [], [3], {}, {"a": 1}, "a" * 2000, "\x1b[2J",
)  # fmt: skip

PYTHONS = ("None", "True", "False", "convert", "Error", "NoneType", "<class", "dict", "tuple", "input_value")
"""What only Python says."""


@pytest.fixture(scope="module")
def engine():
    twin = load_twin("motor_can")
    return Engine(twin, lambda report: twin.open_source(report, live=False))


def answer(engine, body):
    """The line with which a command is refused."""
    with pytest.raises(NisusError) as refused:
        command_from_json(body, engine)
    return str(refused.value)


@pytest.mark.parametrize(
    ("body", "line"),
    [
        ([], "the body is []; it must be like"),
        ({}, "command is missing; choose from SetEstimator, "),
        ({"command": None}, "command is null; choose from SetEstimator, "),
        ({"command": "setTuning"}, "command is 'setTuning'; did you mean SetTuning or SetTunings?"),
        ({"command": "SetTuning", "key": "gate"}, "SetTuning: value is missing; it takes key, value"),
        ({"command": "SetTunings", "values": {}}, "SetTunings: values is empty; it takes the value of each key"),
        ({"command": "SetTunings", "values": [1]}, "SetTunings: values is [1]; it must be an object of numbers"),
        ({"command": "SetTunings", "values": {"Q.yoke": "x"}}, "SetTunings: values.Q.yoke is 'x'; it must be a number"),
        ({"command": "SetTunings", "values": {"Q.yoke": 1, "R.yoke": -1}}, "R.yoke is -1; a variance must be positive"),
        ({"command": "SetTuning", "kee": "gate", "value": 1}, "SetTuning: kee is not known; did you mean key?"),
        ({"command": "SetTuning", "key": "gate", "value": "x"}, "gate is 'x'; it must lie between 0.5 and 1, or"),
        ({"command": "SetTuning", "key": "gate", "value": "0.5"}, "gate is '0.5'; it must lie between 0.5 and 1"),
        ({"command": "SetTuning", "key": "gate", "value": True}, "gate is true; it must lie between 0.5 and 1"),
        ({"command": "SetTuning", "key": "gate.kind", "value": None}, "gate.kind is null; it must be hard or soft"),
        ({"command": "SetTuning", "key": "gate.reopen", "value": "x"}, "gate.reopen is 'x'; it must be a positive"),
        ({"command": "SetTuning", "key": "Q.yoke", "value": "x"}, "Q.yoke is 'x'; it must be a finite number"),
        ({"command": "SetTuning", "key": "use.yoke", "value": "no"}, "use.yoke is 'no'; it must be true or false"),
        ({"command": "SetTuning", "key": "gate", "value": None, "gesture": "g" * 65}, "gesture has 65 charac"
         "ters; it may have 64"),
        ({"command": "SetTuning", "key": "", "value": 1}, "'' is not a tuning key of motor_drive; choose from"),
        ({"command": "SetOption", "name": "jozeph", "value": 1}, "no option 'jozeph'; did you mean joseph?"),
        ({"command": "UseSensor", "name": "yok", "used": False}, "UseSensor: name is 'yok', no sensor of motor_drive"),
        ({"command": "Annotate", "text": "x"}, "Annotate: no measurement has arrived yet; wait for the first"),
        ({"command": "Annotate", "text": 1}, "Annotate: text is 1; it must be a text"),
        ({"command": "Pause", "paused": None}, "Pause: paused is null; it must be true or false"),
        ({"command": "Reset", "now": 1}, "Reset: now is not known; it takes no field"),
        ({"command": "InjectFault", "kind": "bias", "target": "parameter.x", "size": 1}, "target is 'parameter.x', no"),
        ({"command": "InjectFault", "kind": "noise", "target": "yoke", "size": 1e300}, "size is 1e+300; it must be posi"
         "tive, and 1e+50 at most"),
        ({"command": "InjectFault", "kind": "duplicate", "count": 10**30}, "count is too large; it must be below 2^53"),
    ],
    ids=str,
)  # fmt: skip
def test_a_command_that_cannot_be_says_why(engine, body, line):
    said = answer(engine, body)
    assert line in said and "\n" not in said


def bodies():
    """Every field of every command, and every key of a tuning, with what does not belong there."""
    usual = {"key": "gate", "name": "yoke", "value": 0.5, "used": True, "what": "x", "states": ["yoke"], "paused": True,
             "factor": 1.0, "seconds": 1.0, "path": None, "kind": "bias", "target": "yoke", "size": 1.0,
             "text": "x"}  # fmt: skip
    for kind in KINDS:
        fields = dataclasses.fields(kind)
        for field in fields:
            given = {item.name: usual.get(item.name, 0) for item in fields if item.default is dataclasses.MISSING}
            for odd in ODD:
                yield {"command": kind.__name__, **given, field.name: odd}
    for key in ("gate", "gate.kind", "gate.reopen", "Q.yoke", "R.yoke", "R", "p.yoke_coolant", "use.yoke", "use."):
        for odd in ODD:
            yield {"command": "SetTuning", "key": key, "value": odd}
    for option in ("joseph", "adapt", "inflation", "robust"):
        for odd in ODD:
            yield {"command": "SetOption", "name": option, "value": odd}


def test_whatever_is_asked_is_taken_or_refused_in_one_line(engine):
    refused = 0
    for body in bodies():
        try:
            command_from_json(body, engine)
        except NisusError as error:
            said = str(error)
            refused += 1
            assert "\n" not in said and len(said) < 500, said
            assert not [word for word in PYTHONS if word in said], said
            assert "; " in said or "this session" in said or "a live source" in said, said
    assert refused > 400
