"""A fit over HTTP: begun, told, put in, given up, and what is refused."""

import json

import numpy as np
import pytest

from app.live.execute import retuned
from app.web.commands_json import command_from_json
from estimators.errors import NisusError
from tests.app.scripted import readings, wait_for
from tests.app.web.test_door import Page

DONE = ("done", "failed", "cancelled")


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    page = Page(tmp_path)
    rng = np.random.default_rng(4)
    page.source.put(readings(np.arange(1.0, 601.0) * 0.1, 40.0 + rng.normal(size=600)))
    wait_for(lambda: page.rows() == 600)
    yield page
    page.stop()


def look(page):
    return json.loads(page.client.get("/api/fit").text)


def test_a_fit_is_begun_told_and_put_in_at_once(page):
    assert look(page) == {"state": "none", "available": 600}
    answer = page.client.post("/api/fit", {"wanted": ["Q", "R", "Q"]})
    assert answer.status == 202 and json.loads(answer.text)["wanted"] == ["Q", "R"]
    wait_for(lambda: look(page)["state"] in DONE)
    told = look(page)
    assert (told["state"], told["revision"], told["events"], told["current"]) == ("done", 0, 600, True)
    after = {line["key"]: line["after"] for line in told["result"]["entries"] if not line["alone"]}
    assert told["values"] == after and "R.winding" in after
    assert page.client.post("/api/command", {"command": "SetTunings", "values": after}).status == 202
    wait_for(lambda: page.engine.revisions.runs[-1].number == 1)
    assert {key: page.engine.tuning.get(key) for key in after} == after
    assert look(page)["current"] is False


def test_given_up_and_nothing_to_give_up(page):
    headers = [("Host", page.client.host), ("Cookie", page.client.cookie), ("Origin", page.client.origin)]
    answer = page.client.raw("DELETE", "/api/fit", headers)
    assert json.loads(answer.text) == {"state": "none", "available": 600}
    page.client.post("/api/fit", {"wanted": ["Q", "R"]})
    page.client.raw("DELETE", "/api/fit", headers)
    wait_for(lambda: look(page)["state"] in DONE)
    assert "result" not in look(page) and look(page)["state"] == "cancelled"


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ([], "it must be an object of wanted, events"),
        ({"wanted": "Q"}, "wanted is 'Q'; it must be a list of texts"),
        ({"wanted": ["Q"], "more": 1}, "more is not known; choose from wanted, events"),
        ({"wanted": []}, "wanted is empty"),
        ({"wanted": ["Q"], "events": 0}, "events is 0; it must be a positive whole number"),
        ({"wanted": ["Q"], "events": True}, "events is true; it must be a whole number"),
    ],
)
def test_what_is_refused(page, body, reason):
    answer = page.client.post("/api/fit", body)
    assert answer.status == 400 and reason in json.loads(answer.text)["error"]


def test_options_go_with_the_rest(page):
    ask = {"command": "SetTunings", "values": {"Q.rate": 0.5, "options.alpha": 0.3}}
    with pytest.raises(NisusError, match="alpha"):
        command_from_json(ask, page.engine)
    page.client.post("/api/command", {"command": "SetEstimator", "name": "ukf"})
    wait_for(lambda: page.engine.estimator == "ukf")
    name, tuning = retuned(command_from_json(ask, page.engine), page.engine)
    assert (name, tuning.get("Q.rate"), tuning.options["alpha"]) == ("ukf", 0.5, 0.3)
    with pytest.raises(NisusError, match="is an option of the estimator; set it with SetOption"):
        command_from_json({"command": "SetTuning", "key": "options.alpha", "value": 0.3}, page.engine)
