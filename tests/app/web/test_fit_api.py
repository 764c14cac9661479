"""Fits over HTTP, of the log and of the last window: begun, shown, applied, cancelled, adopted, refused."""

import io
import json
import shutil

import pyarrow.parquet as pq
import pytest

from app.engine.execute import retuned
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from config.loader import TWINS
from estimators.errors import NisusError
from tests.cases import cases
from tests.waiting import LIMIT_S, wait_for

DONE = ("done", "failed", "cancelled")


@pytest.fixture
def page(serve):
    return serve(600)


def look(page):
    return page.get("/api/fit")


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


def test_a_stopped_fit_keeps_its_best_values(page, halted):
    page.client.post("/api/fit", {"wanted": ["Q", "R"]})
    assert halted.reached.wait(LIMIT_S)
    told = look(page)
    assert told["state"] == "running" and 0 < told["folds"] <= told["expected"]
    assert told["left"] == pytest.approx(told["elapsed"] * (told["expected"] / told["folds"] - 1.0), rel=0.5)
    assert told["gain"] > 0.0 and " -> " in told["best"]
    headers = [("Host", page.client.host), ("Cookie", page.client.cookie), ("Origin", page.client.origin)]
    assert json.loads(page.client.raw("DELETE", "/api/fit", headers).text)["state"] == "stopping"
    halted.released.set()
    wait_for(lambda: look(page)["state"] in DONE)
    told = look(page)
    assert told["state"] == "done" and told["result"]["stopped"] and told["values"]


@cases(__file__, "refused_fits.csv")
def test_what_is_refused(page, path, body, reason):
    answer = page.client.post(path, json.loads(body))
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


# Dual estimation

SECTION = "{entries: [R.winding], every: 30 s, window: 1 min}"


@pytest.fixture
def twin_page(serve, tmp_path):
    path = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    still = {"refit": SECTION, "Q.rate": "1e-6", "Q.temperature": "1e-6"}
    return serve(650, std=5.0, twin=load_twin(path, overrides=still))


def refits(twin_page):
    return twin_page.get("/api/refit")


def brief(twin_page):
    return twin_page.get("/api/status")["refit"]


def proposed(twin_page):
    twin_page.server.refits.start()
    wait_for(lambda: brief(twin_page)["proposed"] is not None)
    return refits(twin_page)["fits"][0]


def test_a_window_s_fit_is_adopted_and_named_in_every_row(twin_page):
    assert refits(twin_page) == {
        "section": {"entries": ["R.winding"], "every": 30.0, "window": 60.0, "adopt": "by hand"},
        "due": None,
        "fits": [],
    }
    assert brief(twin_page) == {"last": None, "state": None, "proposed": None}
    fit = proposed(twin_page)
    assert brief(twin_page) == {"last": 1, "state": "proposed", "proposed": 1}
    (entry,) = fit["result"]["entries"]
    assert entry["low"] < 25.0 < entry["high"] and entry["sigma"] > 10.0 and fit["result"]["proposed"]
    assert fit["text"].startswith("R.winding 4 → ") and int(fit["end"]) - int(fit["start"]) == 60 * 10**9
    assert refits(twin_page)["due"] == str(65 * 10**9 + 30 * 10**9)

    assert twin_page.post("/api/refit/accept", number=1) == (200, {"name": "refit-1"})
    wait_for(lambda: twin_page.engine.folded_with()[0].name == "refit-1")
    assert refits(twin_page)["fits"][0]["state"] == "adopted" and refits(twin_page)["fits"][0]["name"] == "refit-1"
    table = pq.read_table(io.BytesIO(twin_page.client.get("/api/track.parquet").body))
    assert set(table["tuning"].to_pylist()) == {"refit-1"}
    versions = twin_page.get("/api/tunings")
    assert versions["running"] == "refit-1"
    assert versions["versions"][1]["evidence"]["entries"]["R.winding"]["after"] == entry["after"]


def test_a_window_is_fitted_at_once(twin_page):
    status, told = twin_page.post("/api/refit")
    assert status == 202 and told["fits"][0]["number"] == 1
