"""Health in the API: episodes with their section of docs/alarms.md, causes, states of sensors; and notes of users."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from app.engine.engine import Engine
from app.web.twin_json import episodes_json, status_json
from tests.app.scripted import Scripted, fresh_status, readings, twin
from tests.waiting import LIMIT_S, wait_for

ROOT = Path(__file__).parents[3]


@pytest.fixture
def engine():
    return Engine(twin(), lambda report: Scripted())


def strict(content):
    """As the page gets it: NaN and infinity are no JSON."""
    return json.loads(json.dumps(content, allow_nan=False))


def test_a_stuck_sensor_in_the_api(engine):
    said = strict(status_json(engine))
    assert (said["health"], said["cause"], said["episodes_open"]) == ("waiting", "", 0)
    assert said["sensors"] == {"winding": {"state": "waiting", "text": ""}} and episodes_json(engine) == []
    y = 40.0 + np.random.default_rng(5).normal(0, 2, 200)
    y[100:] = 41.5
    engine._accept([readings(1.0 + np.arange(200), y)])
    engine._watchers.episode_log.update()
    fresh_status(engine)
    (episode,) = strict(episodes_json(engine))
    assert " ".join(episode) == "start end subject cause size low high unit text grade help severity"
    # The first of the equal readings is that at 101 s; what is stuck has a value, and no interval of it.
    assert (episode["start"], episode["end"], episode["subject"], episode["cause"]) == (101.0, None, "winding", "stuck")
    assert (episode["size"], episode["low"], episode["high"], episode["unit"]) == (41.5, None, None, "°C")
    file, _, heading = episode["help"].partition("#")
    assert re.search(rf"^## {heading}$", (ROOT / file).read_text(), re.MULTILINE | re.IGNORECASE)
    said = strict(status_json(engine))
    assert said["health"] == "degraded" and said["cause"] == episode["text"] and said["episodes_open"] == 1
    assert said["sensors"] == {"winding": {"state": "degraded", "text": episode["text"]}}


def test_every_browser_gets_the_notes_of_users(serve):
    page = serve(20)

    def told(browser):
        """The next list of notes that a browser gets."""
        return wait_for(lambda: "annotations" in (message := json.loads(browser.recv(timeout=LIMIT_S))) and message)[
            "annotations"
        ]

    with page.connect("/api/stream") as one, page.connect("/api/stream") as other:
        assert told(one) == told(other) == []
        assert page.post("/api/command", command="Annotate", text="pump off", at=1.5)[0] == 202
        (note,) = told(one)
        assert note == {"number": 1, "at": pytest.approx(1.5, abs=1e-9), "text": "pump off"}
        assert told(other) == page.get("/api/annotations") == [note]
        page.post("/api/command", command="Annotate", number=1, text="pump on")
        assert told(one) == told(other) == [note | {"text": "pump on"}]
        page.post("/api/command", command="DeleteAnnotation", number=1)
        assert told(one) == told(other) == page.get("/api/annotations") == []
    status, answer = page.post("/api/command", command="Annotate", text="x", at=99.0)
    assert status == 400 and answer["error"].startswith("Annotate: at is 99 s; it must lie within the log, 0.1 to 2 s")
