"""A detector is one row of one file: a copy of the package with a row more reports its cause everywhere."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]

ROW = '''
    Detector(
        "rectified",
        "innovations of {0.name} are rectified {0.since}",
        "look for a clipped or rectified signal at {0.sensor}",
        alarms={"rectified": (Density(lambda e: np.log1p(np.clip(0.25 * (e**3 - 3.0 * e), -0.9, 4.0))),)},
        severity=3,
    ),
)
"""Order:'''

SCRIPT = """
import json
from types import SimpleNamespace
import numpy as np
from app.leading import leading
from app.engine.episode_log import EpisodeSummary
from app.render.report import episode_topic
from app.web.twin_json import episodes_json
from estimators.diagnostics.detector_state import sensor_states
from estimators.diagnostics.detectors import ALARM_NAMES, detector_of
from estimators.diagnostics.episodes import EpisodeTracker, episodes, judged_rows
from estimators.log import Log
from tests.models import level_model
from tests.support import folded

model = level_model({"gauge": 1.0}, 1e-8, linear=True)
rng = np.random.default_rng(0)
z = rng.standard_normal(6000)
# Skewness 1.5 at mean 0 and variance 1.
g = rng.gamma(16.0 / 9.0, size=3000)
z[3000:] = (g - 16.0 / 9.0) / (4.0 / 3.0)
log = Log.of(model)
log.add("gauge", 1.0 + np.arange(z.size), z)
fold = folded("filterpy-kf", model, log)  # in Python: of a changed bank, only the detectors are compiled
found = episodes(fold)
judged = judged_rows(fold)
tracker = EpisodeTracker(model, fold.tuning, fold.marginal, max_rows=1000)
for begin in range(0, z.size, 170):
    rows = slice(begin, begin + 170)
    tracker.feed(judged.events.select(rows), judged.track.select(rows))
lasting = tuple(entry for entry in tracker.entries if entry.episode.end is None)
states = sensor_states(model, fold.tuning.used, fold.evidence, 6000.0, fold.policy)
summary = EpisodeSummary((), lasting)
_, cause = leading(model, summary.open, states, fold.track, fold.u)
about = dict(episodes=found, events=judged.events, track=judged.track, tuning=fold.tuning)
print(json.dumps({
    "report": [list(row) for row in episode_topic(SimpleNamespace(**about)).rows],
    "rows": int(np.sum(fold.track.alarms[:, 0] >> ALARM_NAMES.index("rectified") & 1)),
    "episodes": [item._asdict() for item in found],
    "live": [item._asdict() for item in tracker.episodes],
    "state": states["gauge"], "leading": cause, "sensor": summary.of_sensors(states)["gauge"],
    "help": detector_of("rectified").anchor, "json": episodes_json(SimpleNamespace(episodes=lambda: found)),
}))
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    root = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "estimators", root / "estimators", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("app", "config", "sources", "docs", "tests"):
        (root / name).symlink_to(ROOT / name)
    table = root / "estimators/diagnostics/detectors.py"
    text = table.read_text()
    assert text.count(')\n"""Order:') == 1
    table.write_text(text.replace(')\n"""Order:', ROW.lstrip("\n")))
    (root / "newcomer.py").write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(root)}
    run = subprocess.run([sys.executable, "newcomer.py"], cwd=root, capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def test_its_alarm_is_an_episode_of_its_own_with_its_own_numbers(told):
    (episode,) = [item for item in told["episodes"] if item["cause"] == "rectified"]
    assert told["rows"] > 1000 and abs(episode["start"] - 3000.0) < 200.0 and episode["end"] is None
    # Mean log Λ of the row's own test, with its interval.
    assert episode["unit"] == "nats" and 0.0 < episode["low"] < episode["size"] < episode["high"]
    assert "rectified since" in episode["text"] and "rectified signal at gauge" in episode["text"]


def test_status_names_it_and_a_running_twin_finds_the_same(told):
    (episode,) = [item for item in told["live"] if item["cause"] == "rectified"]
    (once,) = [item for item in told["episodes"] if item["cause"] == "rectified"]
    assert (episode["start"], episode["end"], episode["text"]) == (once["start"], None, once["text"])
    assert told["state"] == "suspect" and told["leading"] == once["text"] == told["sensor"][1]


def test_the_report_has_its_cause_and_remedy(told):
    (row,) = [row for row in told["report"] if "rectified" in row]
    assert any("rectified signal" in cell for cell in row)


def test_the_page_links_to_its_heading(told):
    (help_link,) = {item["help"] for item in told["json"] if item["cause"] == "rectified"}
    assert told["help"] == "rectified" and help_link.endswith("#rectified")
