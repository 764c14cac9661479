"""The published state: equal to the last row, complete, and never a number that does not hold."""

import http.client
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError
from starlette.routing import Route

from app.engine.outputs.state_message import PublishedState, StateMessage, _input, state_message, state_schema
from app.web.http import ApiRoute
from estimators import Input, fuse
from estimators.track import DEGRADED, DIVERGED, HEALTH_NAMES, STALE, SUSPECT, TRACKING, WAITING
from tests.app.scripted import pull_all, readings
from tests.cases import cases
from tests.support import SECOND
from tests.waiting import LIMIT_S, wait_for


@pytest.fixture
def page(serve):
    return serve(50)


def last_row(page):
    pull = pull_all(page.engine)
    return pull.events.t[-1], pull.track.mean[-1], pull.track.std[-1]


def state(page, query=""):
    """The answer once the status has the last row, since it is renewed ten times a second."""
    t = int(last_row(page)[0])
    wait_for(lambda: page.get("/api/state")["time_ns"] == t)
    return page.get(f"/api/state{query}")


def test_the_message_has_the_numbers_of_the_last_row(page):
    found, (t, mean, std) = state(page, "?covariance=true"), last_row(page)
    jsonschema.validate(found, page.get("/api/state/schema.json"))
    assert (found["version"], found["twin"], found["time_ns"], found["time"]) == (
        "nisus.state/1", page.engine.twin.name, t, None,
    )  # fmt: skip
    assert [item["value"] for item in found["states"]] == mean.tolist()
    assert [item["std"] for item in found["states"]] == std.tolist()
    assert [item["valid"] for item in found["states"]] == [True] * mean.size and found["estimate_valid"]
    assert found["covariance_of"] == list(page.engine.model.state_names)
    np.testing.assert_allclose(np.sqrt(np.diag(found["covariance"])), std, rtol=1e-12)
    (winding,) = found["sensors"]
    assert (winding["name"], winding["accepted"], winding["rejected"], winding["dropouts"]) == ("winding", 50, 0, 0)
    assert 0.0 <= found["age_s"] < 600.0 and found["sent"].endswith("Z")


def test_two_messages_are_fused(page):
    """The same estimate twice has no more information than once."""
    found = state(page, "?covariance=true")
    fused = fuse(found, found)
    assert fused.states == tuple(page.engine.model.state_names) and fused.agrees
    np.testing.assert_allclose(fused.mean, last_row(page)[1], rtol=1e-12)
    np.testing.assert_allclose(fused.cov, found["covariance"], rtol=1e-9)


def test_rejected_and_empty_measurements_are_counted(page):
    page.source.put(readings([6.0, 7.0, 8.0], [np.nan, np.nan, 40.0]))
    wait_for(lambda: page.rows() == 53)
    (winding,) = state(page)["sensors"]
    assert (winding["accepted"], winding["dropouts"]) == (51, 2)


def test_before_the_first_event_there_is_no_number(serve):
    found = serve().get("/api/state")
    jsonschema.validate(found, state_schema())
    assert (found["health"], found["time_ns"], found["age_s"], found["estimate_valid"]) == (
        "waiting",
        None,
        None,
        False,
    )
    assert {(item["value"], item["std"], item["valid"]) for item in found["states"]} == {(None, None, False)}
    assert all(item["reason"] for item in found["states"])


def changed(page, **fields):
    """The message of a status in which something is otherwise."""
    engine = page.engine
    status = replace(engine.status(), **fields)
    return state_message(
        SimpleNamespace(latest=lambda: status, model=engine.model, twin=engine.twin, belief=engine.belief),
        covariance=True,
    )


@pytest.mark.parametrize("wrong", ["mean", "std"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_whose_mean_or_deviation_is_no_number_is_not_valid(page, wrong, value):
    """As it was published elsewhere: P is NaN beside a finite x."""
    column = last_row(page)[1 if wrong == "mean" else 2].copy()
    column[0] = value
    found = changed(page, t=5 * SECOND, **{wrong: column})
    first, *others = found.states
    assert (first.value, first.grade, first.reason) == (None, "diverged", "the estimate is not a number")
    assert all(item.valid for item in others) and not found.estimate_valid and found.covariance is None
    assert "NaN" not in found.model_dump_json() and "Infinity" not in found.model_dump_json()


@pytest.mark.parametrize(
    ("health", "valid"), [(WAITING, False), (SUSPECT, True), (DEGRADED, True), (DIVERGED, False), (STALE, False)]
)
def test_health_decides_whether_an_estimate_is_published(page, health, valid):
    found = changed(page, t=5 * SECOND, health=health, cause="its cause")
    assert {item.valid for item in found.states} == {valid} and found.estimate_valid == valid
    assert {(item.grade, item.reason) for item in found.states} == {(HEALTH_NAMES[health], "its cause")}


@pytest.mark.parametrize(("grade", "valid"), [("withheld", False), ("suspect", True)])
@pytest.mark.parametrize("health", [TRACKING, SUSPECT])
def test_a_state_that_is_worse_by_itself_says_so_and_the_others_are_as_the_twin(page, grade, valid, health):
    names = [state.name for state in page.engine.model.shown_states]
    found = changed(page, t=5 * SECOND, health=health, cause="stuck", grades={names[0]: (grade, "its own")}).states
    told = [(item.grade, item.valid, item.reason) for item in found]
    assert told == [(grade, valid, "its own"), (HEALTH_NAMES[health], True, "stuck" * (health == SUSPECT))]


def test_a_time_of_the_calendar_is_written_as_such(page):
    assert changed(page, t=1700006390000001000).time == "2023-11-14T23:59:50.000001Z"


@cases(__file__, "invalid_states.csv")
def test_no_message_can_hold_a_value_without_validity(fields):
    with pytest.raises(ValidationError):
        PublishedState(name="x", unit="1", protection_level=None, **json.loads(fields))


def test_the_stream_sends_each_change(page):
    t = int(last_row(page)[0])
    connection = http.client.HTTPConnection("127.0.0.1", page.client.port, timeout=LIMIT_S)
    connection.request("GET", "/api/state/stream", headers={"Cookie": page.client.cookie})
    answer = connection.getresponse()
    assert (answer.status, answer.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")

    def until(time_ns):
        def sent():
            line = answer.readline().decode()
            assert line, "the stream has ended"
            message = line.startswith("data: ") and StateMessage.model_validate_json(line.removeprefix("data: "))
            return message and message.time_ns == time_ns and message

        return wait_for(sent)

    first = until(t)
    page.source.put(readings([6.0], [41.0]))
    second = until(6 * SECOND)
    assert second.states[0].value == last_row(page)[1][0] != first.states[0].value
    connection.close()


def test_supervisors_need_no_token(serve):
    page = serve()
    host = [("Host", page.client.host)]
    assert [page.client.raw("GET", path, host).status for path in ("/healthz", "/readyz", "/api/state")] == [
        200,
        503,
        403,
    ]
    page.source.put(readings([1.0], [40.0]))
    wait_for(lambda: page.client.raw("GET", "/readyz", host).status == 200)
    assert page.get("/api/state")["time_ns"] == SECOND


def test_the_description_of_the_api_has_every_path_and_is_true(page):
    found = page.get("/api/openapi.json")
    served = {
        re.sub(r":\w+}", "}", route.path)
        for route in page.server.application.routes
        if isinstance(route, Route) and route.path.startswith("/api/")
    }
    assert served <= found["paths"].keys() and {"/healthz", "/readyz", "/metrics"} <= found["paths"].keys()
    models = found["components"]["schemas"]

    def check(schema, value=None):
        jsonschema.Draft202012Validator.check_schema(schema)
        if value is not None:
            jsonschema.Draft202012Validator(schema | {"components": found["components"]}).validate(value)

    operations = [item for path in found["paths"].values() for item in path.values()]
    assert [item["operationId"] for item in operations if not item["summary"]] == []
    assert found["paths"]["/api/alerts/schema.json"]["get"]["parameters"] == []
    # What a client may give is declared by a function of our own.
    works = [item.operation.work for item in page.server.application.routes if isinstance(item, ApiRoute)]
    assert len(works) > 30 and all(work.__module__.startswith("app.") for work in works)
    for schema in [*models.values(), *(part["schema"] for item in operations for part in item.get("parameters", ()))]:
        check(schema)
    for name in re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(found)):
        assert name in models
    state_of = found["paths"]["/api/state"]["get"]
    assert [(item["name"], item["in"]) for item in state_of["parameters"]] == [("covariance", "query")]
    check(state_of["responses"]["200"]["content"]["application/json"]["schema"], page.get("/api/state?covariance=true"))
    command = found["paths"]["/api/command"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    check(command, {"command": "SetTuning", "key": "Q.temperature", "value": 1.0})
    check(command, {"command": "Reset"})
    with pytest.raises(jsonschema.ValidationError):
        check(command, {"command": "SetTuning", "value": 1.0})


@pytest.mark.parametrize("value, valid", [(14.9, False), (15.1, True)])
def test_an_input_is_valid_as_far_as_its_model_holds(value, valid):
    assert _input(Input("air", "°C", fitted=(20.0, 30.0), near=5.0), value).valid == valid
