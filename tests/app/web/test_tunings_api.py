"""Tuning versions over HTTP: listed, a run kept as one, one loaded, and what is refused."""

import json
import shutil

import numpy as np
import pytest

from app.live.commands import SetTuning
from app.studies.baseline import ComparedFigure
from app.studies.guard import GuardVerdict, keep_last
from app.twin.twin import load_twin
from config.loader import TWINS
from estimators.fold import Fold
from tests.app.scripted import readings, wait_for
from tests.app.web import test_door
from tests.app.web.test_door import Page


@pytest.fixture
def page(tmp_path, monkeypatch):
    path = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    monkeypatch.setattr(test_door, "shown_twin", lambda: load_twin(path))
    page = Page(tmp_path)
    rng = np.random.default_rng(4)
    page.source.put(readings(np.arange(1.0, 301.0) * 0.1, 40.0 + rng.normal(size=300)))
    wait_for(lambda: page.rows() == 300)
    yield page
    page.stop()


def post(page, path, **fields):
    answer = page.client.post(path, fields)
    return answer.status, json.loads(answer.text)


def tunings(page):
    return json.loads(page.client.get("/api/tunings").text)


def test_what_guard_said_last_is_listed_beside_the_versions(page):
    assert tunings(page)["guard"] == []
    worse = ComparedFigure("rmse.temperature", 0.5, 0.6, 0.1, 0.01)
    keep_last(page.engine.twin.path, [GuardVerdict("winding", "own", [worse])])
    (said,) = tunings(page)["guard"]
    assert said["recording"] == "winding" and said["figures"] == 1
    assert said["worse"] == ["rmse.temperature was 0.5 and is 0.6: worse by 0.1, allowed 0.01"]


def turn(page, key, value):
    before = page.engine.status().revision
    page.engine.submit(SetTuning(key, value))
    wait_for(lambda: page.engine.status().revision > before and not page.engine.status().refolding)


def test_a_run_is_kept_and_loaded_again(page, tmp_path):
    assert tunings(page)["running"] == "own" and [item["name"] for item in tunings(page)["versions"]] == ["own"]
    turn(page, "R.winding", 0.5)
    assert tunings(page)["running"] == "own*"
    assert post(page, "/api/tunings", run=1, name="quiet", note="tried") == (200, {"name": "quiet"})
    (_, version) = tunings(page)["versions"]
    assert version["name"] == "quiet" and version["note"] == "tried" and not version["holds"]
    score = json.loads(page.client.get("/api/runs").text)[1]["score"]
    assert version["scores"]["nis"] == pytest.approx(score["nis"], rel=1e-7)

    turn(page, "Q.rate", 5.0)
    before = page.engine.status().revision
    assert post(page, "/api/tunings/load", name="quiet") == (200, {"name": "quiet"})
    wait_for(lambda: page.engine.status().revision > before and not page.engine.status().refolding)
    status = page.engine.status()
    # What was turned since is left behind.
    twin = load_twin(tmp_path / "winding.yaml", overrides={"tuning": "quiet"})
    assert status.tuning.name == "quiet" and tunings(page)["running"] == "quiet"
    np.testing.assert_array_equal(status.tuning.q, twin.tuning.q)
    np.testing.assert_array_equal(status.tuning.r, [0.5])
    # The same fold as that of the command line.
    fold = Fold("kf", twin.model, twin.tuning, page.engine._log.copy(), policy=twin.policy)
    fold.advance()
    np.testing.assert_array_equal(page.engine._fold.track.mean, fold.track.mean)
    assert json.loads(page.client.get("/api/runs").text)[-1]["what"].startswith("version quiet: ")
    # And back to what the file says.
    before = status.revision
    assert post(page, "/api/tunings/load", name="own") == (200, {"name": "own"})
    wait_for(lambda: page.engine.status().revision > before and not page.engine.status().refolding)
    assert page.engine.status().tuning.name == "own" and page.engine.status().tuning.get("R.winding") == 4.0


@pytest.mark.parametrize(
    ("path", "fields", "said"),
    [
        ("/api/tunings", {"run": 0, "name": "own", "note": ""}, "the version's name is 'own'; use letters"),
        ("/api/tunings", {"run": 0, "name": "../a", "note": ""}, "the version's name is '../a'; use letters"),
        ("/api/tunings", {"run": 7, "name": "a", "note": ""}, "run 7 is not known"),
        ("/api/tunings", {"run": True, "name": "a", "note": ""}, "run is true; it must be a whole number"),
        ("/api/tunings", {"run": 0, "name": "a"}, "note is missing; it takes run, name, note"),
        ("/api/tunings", {"run": 0, "name": "a", "note": "x" * 2001}, "note: it has 2001 characters; it may have 2000"),
        ("/api/tunings/load", {"name": "nobody"}, "--tuning nobody: winding has no such version"),
        ("/api/tunings/load", {"name": "/etc/passwd"}, "/etc/passwd: no version is read from there"),
        ("/api/tunings/load", {"name": 3}, "name is 3; it must be a text"),
    ],
)
def test_what_is_refused(page, path, fields, said):
    status, answer = post(page, path, **fields)
    assert status == 400 and said in answer["error"]
    assert len(tunings(page)["versions"]) == 1 and page.engine.status().tuning.name == "own"
