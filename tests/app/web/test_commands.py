"""Refused commands are answered in one line with value, rule and remedy, in terms of JSON."""

import dataclasses
import json
import math
import typing

import pytest

from app.live import commands
from app.live.engine import Engine
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from estimators.errors import NisusError
from tests.cases import cases
from tests.support import error_of

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
    return error_of(NisusError, command_from_json, body, engine)


@cases(__file__, "refused_commands.csv")
def test_a_command_that_cannot_be_says_why(engine, body, line):
    said = answer(engine, json.loads(body))
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
