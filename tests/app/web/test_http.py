"""Bodies and queries of requests: invalid ones are refused in one line, commands with value, rule and remedy."""

import asyncio
import dataclasses
import json
import math
import typing

import pytest
from starlette.requests import Request

from app.charts.chart_stream import ChartQuery, ChartStream
from app.columns import columns_of
from app.engine import commands
from app.engine.engine import Engine
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from app.web.http import get, parse, post
from app.web.streams import PageMessage
from config.extensions import Part, registered
from estimators.errors import ConfigError, NisusError
from estimators.models import MODELS
from tests.app.scripted import notice_texts
from tests.cases import cases
from tests.support import error_of


def answer(route, body=b"", query=""):
    """Status and body of the answer to a request."""

    async def receive():
        return {"type": "http.request", "body": body, "more_body": False}

    headers = [(b"content-type", b"application/json")]
    scope = {"type": "http", "method": "POST", "path": "/api/x", "query_string": query.encode(), "headers": headers}
    response = asyncio.run(route.endpoint(Request(scope, receive)))
    return response.status_code, bytes(response.body).decode()


@pytest.mark.parametrize("body", [b"", b"{", b"\xff\xfe", b"[" * 30_000, b"1" * 5000])
def test_a_body_that_is_no_json_is_refused(body):
    status, text = answer(post("/api/x", lambda body: body), body)
    assert status == 400 and "the body is no JSON" in text


def keep(run: int, name: str, note: str = "") -> list:
    return [run, name, note]


def test_a_body_becomes_arguments():
    assert answer(post("/api/x", lambda body: body), b"[1]") == (200, "[1]")
    assert answer(post("/api/x", keep, status=202), b'{"run": 3, "name": "a"}') == (202, '[3,"a",""]')


@cases(__file__, "refused_bodies.csv")
def test_a_body_that_breaks_a_rule_is_refused(body, words):
    status, text = answer(post("/api/x", keep), body.encode())
    assert status == 400 and words in json.loads(text)["error"]


def broken_route(engine):
    return get("/api/depth", lambda: 1 // 0)


def test_a_route_of_an_extension_that_fails_is_one_line(serve, monkeypatch):
    monkeypatch.setitem(registered("routes"), "/api/depth", ("depth", Part("", f"{__name__}:broken_route")))
    page = serve()
    line = "extension depth: /api/depth of its routes: ZeroDivisionError: integer division or modulo by zero"
    found = page.client.get("/api/depth")
    assert (found.status, found.text) == (500, json.dumps({"error": line}, separators=(",", ":")))
    assert line in notice_texts(page.engine)


def test_a_message_may_leave_out_what_has_a_default():
    assert parse(PageMessage, {"drawn": True}, "page") == PageMessage(drawn=True, pair=None, streams={})


def test_a_query_becomes_arguments():
    def look(run: int | None = None, since: float = 0.0) -> list:
        return [run, since]

    assert answer(get("/api/x", look), query="run=3&since=2.5&other=1") == (200, "[3,2.5]")
    assert answer(get("/api/x", look)) == (200, "[null,0.0]")
    status, text = answer(get("/api/x", look, refused=409), query="run=three")
    assert status == 409 and "x: run is 'three'; it must be a whole number" in text


@cases(__file__, "refused_queries.csv")
def test_a_chart_query_that_breaks_a_rule_is_refused(body):
    columns = columns_of(MODELS["motor_winding"])
    query = json.loads(body.replace('"MANY"', json.dumps(["mean:rate"] * 401)))
    text = error_of(ConfigError, lambda: ChartStream("x", parse(ChartQuery, query, "stream x"), columns))
    assert text.startswith("stream x: ")


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


def answered(engine, body):
    """The line with which a command is refused."""
    return error_of(NisusError, command_from_json, body, engine)


@cases(__file__, "refused_commands.csv")
def test_a_command_that_cannot_be_says_why(engine, body, line):
    said = answered(engine, json.loads(body))
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
