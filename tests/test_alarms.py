"""docs/alarms.md has a heading for every cause and every state, with diagnosis and response."""

import ast
import re
from pathlib import Path

import pytest

from app.engine.copies import Status
from app.engine.outputs.alerts import GUIDES
from config.schema import TwinSection
from estimators.diagnostics.detector_state import SENSOR_STATES
from estimators.diagnostics.detectors import ALARM_NAMES, CAUSES, DETECTORS, anchor
from estimators.diagnostics.effects import KINDS
from estimators.diagnostics.episodes.sensors import LOSSES, OF_ALL_ROWS
from estimators.track import HEALTH_NAMES, VERDICT_NAMES

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs/alarms.md").read_text()


def sections():
    """The text under each heading of the second level, by the anchor that GitHub makes of it."""
    parts = re.split(r"^## (.+)$", TEXT, flags=re.MULTILINE)
    return {title.lower().replace(" ", "-"): body for title, body in zip(parts[1::2], parts[2::2], strict=True)}


def test_every_detector_with_an_effect_has_a_way_to_estimate_it():
    estimated = {*KINDS, *OF_ALL_ROWS, *LOSSES} - {"screened"}
    assert {row.name for row in DETECTORS if row.alarms and row.effect} == estimated
    assert {"stale", "diverged"} <= set(HEALTH_NAMES) & set(CAUSES)


def test_no_two_detectors_share_a_name_or_an_alarm():
    assert len(set(CAUSES)) == len(CAUSES) and len(set(ALARM_NAMES)) == len(ALARM_NAMES) < 31
    assert all(row.wording and row.remedy for row in DETECTORS)


@pytest.mark.parametrize("cause", CAUSES)
def test_each_cause_says_what_it_is_and_what_to_do(cause):
    body = sections()[anchor(cause)]
    for part in ("Usual cause:", "Look at:", "Response:", "Clears:"):
        assert part in body, part
    assert body.strip().startswith("*")


@pytest.mark.parametrize("state", sorted({*HEALTH_NAMES, *SENSOR_STATES}))
def test_each_state_has_its_heading(state):
    body = sections()[anchor(state)]
    assert "Response:" in body or "Clears:" in body


def constants_of(path):
    """The assignments at the top level of a module, each as texts by name."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign):
            (target,) = node.targets
            several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
            pairs = zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]
            try:
                yield {name.id: ast.literal_eval(value) for name, value in pairs}
            except ValueError:
                continue  # It is computed.


def outcomes():
    """What is decided of sensors that stay refused."""
    (found,) = (names for names in constants_of(ROOT / "estimators/gate/isolation.py") if "DOUBTED" in names)
    return set(found.values())


OF_THE_PROGRAM = {
    "episodes",
    "engine error",
    "view error",
    "sweep",
    "recording failed",
    "stale",
    "readings",
    "page error",
    "request failed",
}
"""Keys of notices that report what is wrong with the program or a disk; the others are no
alarm, or a state of health."""


def notices():
    """Words under which the running twin counts what it reports, and what it counts of readings."""
    found = set()
    for path in (ROOT / "app").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node, "func", None)
            if isinstance(node, ast.Call) and "report" in (getattr(name, "attr", ""), getattr(name, "id", "")):
                found |= {arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)}
    values = {}
    for path in (ROOT / "app/twin/ingest.py", ROOT / "sources/source.py"):
        for names in constants_of(path):
            values |= names
    found |= {values[name] for name in ("WRONG_TIME", "CLOCK_MOVED", "MAINTENANCE")}
    verdicts = {name for name in VERDICT_NAMES if name not in ("none", "used")}
    return (found | verdicts | {"recovered"}) - OF_THE_PROGRAM


SETTINGS = {"baseline", "integrity", "refit"}
"""A section of the YAML and a figure of the status that change what the twin says."""


def test_the_settings_are_there():
    assert {"baseline", "refit"} <= TwinSection.model_fields.keys() and "integrity" in Status.__dataclass_fields__


@pytest.mark.parametrize("word", sorted(outcomes() | notices() | SETTINGS))
def test_each_word_of_a_notice_says_what_to_do(word):
    body = sections()[anchor(word)]
    assert body.strip() and "*Clears:*" in body
    assert "*Response:*" in body or word in SENSOR_STATES or anchor(word) in CAUSES


def test_nothing_is_explained_that_is_never_said():
    said = {*CAUSES, *HEALTH_NAMES, *SENSOR_STATES, *outcomes(), *notices(), *SETTINGS, *GUIDES}
    assert set(sections()) == {anchor(name) for name in said}


def test_the_readme_leads_there():
    assert "docs/alarms.md" in (ROOT / "README.md").read_text()
