"""Bodies and queries of requests: invalid ones are refused in one line."""

import asyncio
import json

import pytest
from starlette.requests import Request

from app.present.series.chart_stream import ChartQuery, ChartStream
from app.present.series.columns import columns_of
from app.web.http import get, parse, post
from app.web.streams import PageMessage
from estimators.errors import ConfigError
from estimators.models import MODELS
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
