"""Dual estimation over HTTP: told, adopted, named in every row, dismissed, and what is refused."""

import io
import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from app.twin.twin import load_twin
from config.loader import TWINS
from tests.app.scripted import readings, wait_for
from tests.app.web import test_door
from tests.app.web.test_door import Page

SECTION = "{entries: [R.winding], every: 30 s, window: 1 min}"


@pytest.fixture
def page(tmp_path, monkeypatch):
    path = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    still = {"refit": SECTION, "Q.rate": "1e-6", "Q.temperature": "1e-6"}
    monkeypatch.setattr(test_door, "shown_twin", lambda: load_twin(path, overrides=still))
    page = Page(tmp_path)
    rng = np.random.default_rng(4)
    page.source.put(readings(np.arange(1.0, 651.0) * 0.1, 40.0 + 5.0 * rng.normal(size=650)))
    wait_for(lambda: page.rows() == 650)
    yield page
    page.stop()


def post(page, path, **fields):
    answer = page.client.post(path, fields)
    return answer.status, json.loads(answer.text)


def look(page):
    return json.loads(page.client.get("/api/refit").text)


def brief(page):
    return json.loads(page.client.get("/api/status").text)["refit"]


def proposed(page):
    page.server.refits.start()
    wait_for(lambda: brief(page)["proposed"] is not None)
    return look(page)["fits"][0]


def test_told_adopted_and_named_in_every_row(page):
    assert look(page) == {
        "section": {"entries": ["R.winding"], "every": 30.0, "window": 60.0, "adopt": "by hand"},
        "due": None,
        "fits": [],
    }
    assert brief(page) == {"last": None, "state": None, "proposed": None}
    fit = proposed(page)
    assert brief(page) == {"last": 1, "state": "proposed", "proposed": 1}
    (entry,) = fit["result"]["entries"]
    assert entry["low"] < 25.0 < entry["high"] and entry["sigma"] > 10.0 and fit["result"]["proposed"]
    assert fit["text"].startswith("R.winding 4 → ") and int(fit["end"]) - int(fit["start"]) == 60 * 10**9
    assert look(page)["due"] == str(65 * 10**9 + 30 * 10**9)

    assert post(page, "/api/refit/accept", number=1) == (200, {"name": "refit-1"})
    wait_for(lambda: page.engine.folded_with()[0].name == "refit-1")
    assert look(page)["fits"][0]["state"] == "adopted" and look(page)["fits"][0]["name"] == "refit-1"
    table = pq.read_table(io.BytesIO(page.client.get("/api/track.parquet").body))
    assert set(table["tuning"].to_pylist()) == {"refit-1"}
    versions = json.loads(page.client.get("/api/tunings").text)
    assert versions["running"] == "refit-1"
    assert versions["versions"][1]["evidence"]["entries"]["R.winding"]["after"] == entry["after"]


def test_dismissed(page):
    proposed(page)
    status, told = post(page, "/api/refit/dismiss", number=1)
    assert status == 200 and told["fits"][0]["state"] == "dismissed"
    assert brief(page)["proposed"] is None and page.engine.folded_with()[0].name == "own*"


def test_at_once(page):
    status, told = post(page, "/api/refit")
    assert status == 202 and told["fits"][0]["number"] == 1


@pytest.mark.parametrize(
    ("path", "fields", "reason"),
    [
        ("/api/refit/accept", {"number": 7}, "refit 7: it is not known"),
        ("/api/refit/dismiss", {"number": 7}, "refit 7: it is not known"),
        ("/api/refit/accept", {"number": "1"}, "number is '1'; it must be a whole number"),
        ("/api/refit/accept", {}, "number is missing"),
        ("/api/refit", {"entries": []}, "entries is not known; it takes no field"),
    ],
)
def test_what_is_refused(page, path, fields, reason):
    status, told = post(page, path, **fields)
    assert status == 400 and reason in told["error"]
