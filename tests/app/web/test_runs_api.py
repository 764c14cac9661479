"""Runs and tuning versions over HTTP: list, pin, name, load, compare, keep, save, refuse."""

import json
import shutil

import numpy as np
import pytest
import yaml

from app.engine.commands import SetTuning
from app.twin.twin import load_twin
from config.loader import TWINS
from estimators.tuning import Tuning
from tests.app.scripted import MODEL
from tests.app.served import VERDICT, keep_verdicts
from tests.cases import cases
from tests.support import folded
from tests.waiting import wait_for

FIRST = Tuning.of(MODEL)
UNIT = next(item.unit for item in FIRST.items() if item.key == "Q.rate")


@pytest.fixture
def page(serve):
    return serve(300)


def test_runs_are_listed_with_what_changed_and_scores(page):
    page.command("SetTuning", key="Q.rate", value=0.5)
    page.command("SetEstimator", name="ukf")
    # The newest revision has a score once its first rows can be copied.
    wait_for(lambda: page.get("/api/runs")[-1]["score"])
    listed = page.get("/api/runs")
    assert [run["number"] for run in listed] == [0, 1, 2]
    assert [run["what"] for run in listed] == [
        "as it began",
        f"Q.rate {FIRST.get('Q.rate'):.6g} → 0.5 {UNIT}",
        "kf → ukf",
    ]
    assert [run["running"] for run in listed] == [False, False, True]
    assert [run["kept"] for run in listed] == [False, True, True] and listed[0]["first"]
    for run in listed:
        assert run["score"]["readings"] == 300
        assert run["score"]["log_likelihood_reading"] == pytest.approx(run["score"]["log_likelihood"] / 300)
    # On a linear model both filters are the same.
    assert listed[1]["score"]["nis"] == pytest.approx(listed[2]["score"]["nis"], rel=1e-6)


def test_pinned_named_and_loaded(page):
    assert page.command("Pin", number=0) is None
    assert page.command("Note", number=0, name="calm", note="as delivered") is None
    page.command("SetTuning", key="Q.rate", value=0.5)
    told = page.get("/api/status")["runs"]
    assert told["last"] == 0
    assert told["pinned"] == [{"number": 0, "place": 0, "name": "calm", "running": False}]
    assert page.command("Load", number=0) is None
    wait_for(lambda: page.engine.status().tuning.get("Q.rate") == FIRST.get("Q.rate"))
    *_, last = page.get("/api/runs")
    assert last["what"].startswith("back to run 0: Q.rate 0.5 →")
    assert (last["number"], last["loaded"], last["name"], last["note"]) == (2, 0, "calm", "as delivered")


def test_two_runs_are_compared(page):
    page.command("SetTuning", key="Q.rate", value=0.5)
    page.command("SetTuning", key="gate", value=0.99)
    answer = page.get("/api/runs/0/against/2")
    assert answer == [
        {"key": "Q.rate", "values": [FIRST.get("Q.rate"), 0.5]},
        {"key": "gate", "values": [None, 0.99]},
    ]
    assert page.get("/api/runs/1/against/1") == []
    assert {page.client.get(f"/api/runs/0/against/{run}").status for run in ("9", "9" * 5000)} == {404}


def test_what_the_data_say_is_folded_when_asked(page):
    first = page.get("/api/around?key=Q.rate")
    assert first["key"] == "Q.rate"
    done = []
    wait_for(lambda: done.append(page.get("/api/around?key=Q.rate")) or done[-1]["done"])
    found = done[-1]
    assert len(found["points"]) == 7 and found["events"] == 300
    assert found["best"] == max(found["points"], key=lambda point: point["log_likelihood"])["value"]
    noise = page.get("/api/noise")
    assert noise["R"]["R.winding"]["n"] == 300 and noise["Q"]["key"] == "Q"
    refused = page.client.get("/api/around?key=gate")
    assert refused.status == 400 and "cannot be swept" in refused.text


def test_yaml_of_a_run_is_text_to_save(page, monkeypatch):
    monkeypatch.setattr(page.engine, "twin", load_twin("motor_winding"))
    page.command("SetTuning", key="Q.rate", value=0.5)
    page.command("Note", number=1, name="fast", note="two\nlines")
    answer = page.client.get("/api/runs/1.yaml")
    assert answer.headers["content-disposition"] == 'attachment; filename="motor_winding-run1.yaml"'
    assert answer.text.startswith("# motor_winding, run 1: fast\n# two\n# lines\n")
    assert yaml.safe_load(answer.text)["noise"]["rate"] == {"variance": 0.5}
    assert page.client.get("/api/runs/7.yaml").status == 404


# Tuning versions


@pytest.fixture
def twin_page(serve, tmp_path):
    path = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    return serve(300, twin=load_twin(path))


def tunings(twin_page):
    return twin_page.get("/api/tunings")


def test_what_guard_said_last_is_listed_beside_the_versions(twin_page):
    assert tunings(twin_page)["guard"] == []
    newer = VERDICT | {"recording": "drive", "at": "2026-11-23T10:30:00Z"}
    keep_verdicts(twin_page.engine.twin.path, VERDICT, newer)
    assert tunings(twin_page)["guard"] == [newer, VERDICT]


def turn(twin_page, key, value):
    twin_page.refolded(lambda: twin_page.engine.submit(SetTuning(key, value)))


def load(twin_page, name):
    assert twin_page.refolded(lambda: twin_page.post("/api/tunings/load", name=name)) == (200, {"name": name})


def test_a_run_is_kept_and_loaded_again(twin_page, tmp_path):
    before = tunings(twin_page)
    assert before["running"] == "own" and [item["name"] for item in before["versions"]] == ["own"]
    turn(twin_page, "R.winding", 0.5)
    assert tunings(twin_page)["running"] == "own*"
    assert twin_page.post("/api/tunings", run=1, name="quiet", note="tried") == (200, {"name": "quiet"})
    (_, version) = tunings(twin_page)["versions"]
    assert version["name"] == "quiet" and version["note"] == "tried" and not version["holds"]
    score = twin_page.get("/api/runs")[1]["score"]
    assert version["scores"]["nis"] == pytest.approx(score["nis"], rel=1e-7)

    turn(twin_page, "Q.rate", 5.0)
    load(twin_page, "quiet")
    status = twin_page.engine.status()
    # What was turned since is left behind.
    twin = load_twin(tmp_path / "winding.yaml", overrides={"tuning": "quiet"})
    assert status.tuning.name == "quiet" and tunings(twin_page)["running"] == "quiet"
    np.testing.assert_array_equal(status.tuning.q, twin.tuning.q)
    np.testing.assert_array_equal(status.tuning.r, [0.5])
    # The same fold as that of the command line.
    fold = folded("kf", twin.model, twin_page.engine._log.copy(), twin.tuning, policy=twin.policy)
    np.testing.assert_array_equal(twin_page.engine._fold.track.mean, fold.track.mean)
    assert twin_page.get("/api/runs")[-1]["what"].startswith("version quiet: ")
    # And back to what the file says.
    load(twin_page, "own")
    assert twin_page.engine.status().tuning.name == "own" and twin_page.engine.status().tuning.get("R.winding") == 4.0


@cases(__file__, "refused_versions.csv")
def test_what_is_refused_of_versions(twin_page, path, fields, said):
    status, answer = twin_page.post(path, **json.loads(fields))
    assert status == 400 and said in answer["error"]
    assert len(tunings(twin_page)["versions"]) == 1 and twin_page.engine.status().tuning.name == "own"
