"""Runs over HTTP: what is listed, pinned, named, loaded, compared and saved, and what is refused."""

import json

import numpy as np
import pytest
import yaml

from app.live.commands import SetTuning
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, readings, wait_for
from tests.app.web.test_door import Page

FIRST = Tuning.of(MODEL)


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    page = Page(tmp_path)
    rng = np.random.default_rng(4)
    page.source.put(readings(np.arange(1.0, 301.0) * 0.1, 40.0 + rng.normal(size=300)))
    wait_for(lambda: page.rows() == 300)
    yield page
    page.stop()


def ask(page, command, **fields):
    """A command, carried out; the reason if it was refused."""
    before = page.engine.revisions.version
    answer = page.client.post("/api/command", {"command": command, **fields})
    if answer.status != 202:
        return json.loads(answer.text)["error"]
    wait_for(lambda: page.engine.revisions.version > before)
    return None


def runs(page):
    return json.loads(page.client.get("/api/runs").text)


def test_runs_are_listed_with_what_changed_and_scores(page):
    ask(page, "SetTuning", key="Q.rate", value=0.5)
    ask(page, "SetEstimator", name="ukf")
    listed = runs(page)
    assert [run["number"] for run in listed] == [0, 1, 2]
    assert [run["what"] for run in listed] == ["as it began", f"Q.rate {FIRST.get('Q.rate'):.6g} → 0.5", "kf → ukf"]
    assert [run["running"] for run in listed] == [False, False, True]
    assert listed[0]["score"] is None and listed[0]["unscored"] == "not scored: its track is gone"
    for run in listed[1:]:
        assert run["score"]["readings"] == 300
        assert run["score"]["log_likelihood_reading"] == pytest.approx(run["score"]["log_likelihood"] / 300)
    # On a linear model both filters are the same.
    assert listed[1]["score"]["nis"] == pytest.approx(listed[2]["score"]["nis"], rel=1e-6)


def test_pinned_named_and_loaded(page):
    assert ask(page, "Pin", number=0) is None
    assert ask(page, "Note", number=0, name="calm", note="as delivered") is None
    ask(page, "SetTuning", key="Q.rate", value=0.5)
    told = json.loads(page.client.get("/api/status").text)["runs"]
    assert told["last"] == 0
    assert told["pinned"] == [{"number": 0, "place": 0, "name": "calm", "running": False}]
    assert ask(page, "Load", number=0) is None
    wait_for(lambda: page.engine.status().tuning.get("Q.rate") == FIRST.get("Q.rate"))
    *_, last = runs(page)
    assert last["what"].startswith("back to run 0: Q.rate 0.5 →")
    assert (last["number"], last["loaded"], last["name"], last["note"]) == (2, 0, "calm", "as delivered")


def test_what_cannot_be_is_one_line(page):
    for value in (0.1, 0.2, 0.3, 0.4):
        assert ask(page, "Pin", number=page.engine.revisions.runs[-1].number) is None
        ask(page, "SetTuning", key="Q.rate", value=value)
    assert ask(page, "Pin", number=4) == "run 4 cannot be pinned: 4 are (0, 1, 2, 3); unpin one first"
    for command in ("Pin", "Unpin", "Load"):
        assert ask(page, command, number=99) == "run 99 is not known; /api/runs lists those that are"
    assert "it may have 60" in ask(page, "Note", number=0, name="x" * 61)
    assert "must be a whole number" in ask(page, "Pin", number="0")


def test_two_runs_are_compared(page):
    ask(page, "SetTuning", key="Q.rate", value=0.5)
    ask(page, "SetTuning", key="gate", value=0.99)
    answer = json.loads(page.client.get("/api/runs/0/against/2").text)
    assert answer == [
        {"key": "Q.rate", "values": [FIRST.get("Q.rate"), 0.5]},
        {"key": "gate", "values": [None, 0.99]},
    ]
    assert json.loads(page.client.get("/api/runs/1/against/1").text) == []
    assert page.client.get("/api/runs/0/against/9").status == 404


def test_what_the_data_say_is_folded_when_asked(page):
    first = json.loads(page.client.get("/api/around?key=Q.rate").text)
    assert first["key"] == "Q.rate"
    done = []
    wait_for(lambda: done.append(json.loads(page.client.get("/api/around?key=Q.rate").text)) or done[-1]["done"])
    found = done[-1]
    assert len(found["points"]) == 7 and found["events"] == 300
    assert found["best"] == max(found["points"], key=lambda point: point["log_likelihood"])["value"]
    noise = json.loads(page.client.get("/api/noise").text)
    assert noise["R"]["R.winding"]["n"] == 300 and noise["Q"]["key"] == "Q"
    refused = page.client.get("/api/around?key=gate")
    assert refused.status == 400 and "cannot be swept" in refused.text


def test_an_edit_of_a_drag_keeps_the_first_to_compare_with(page):
    before = page.engine.revisions.version
    for value in np.geomspace(0.1, 1.0, 10):
        page.engine.submit(SetTuning("Q.rate", float(value)))
    wait_for(lambda: page.engine.revisions.version > before and not page.engine.status().refolding)
    listed = runs(page)
    assert [run["what"] for run in listed] == ["as it began", f"Q.rate {FIRST.get('Q.rate'):.6g} → 1"]
    assert listed[0]["kept"] and listed[0]["score"] is not None


def test_yaml_of_a_run_is_text_to_save(page, monkeypatch):
    from app.twin.twin import load_twin

    monkeypatch.setattr(page.engine, "twin", load_twin("motor_winding"))
    ask(page, "SetTuning", key="Q.rate", value=0.5)
    ask(page, "Note", number=1, name="fast", note="two\nlines")
    answer = page.client.get("/api/runs/1.yaml")
    assert answer.headers["content-disposition"] == 'attachment; filename="motor_winding-run1.yaml"'
    assert answer.text.startswith("# motor_winding, run 1: fast\n# two\n# lines\n")
    assert yaml.safe_load(answer.text)["noise"]["rate"] == {"variance": 0.5}
    assert page.client.get("/api/runs/7.yaml").status == 404
