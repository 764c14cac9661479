"""Alerts of fleets: each asset is in alarm as a twin of its own would be, and those of a moment are one message."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from app.extensions.fleet.alerts import MAX_LISTED, FleetRules
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.publisher import FleetPublisher
from app.extensions.fleet.running import RunningFleet
from app.extensions.fleet.schema import FleetAlertSection
from app.outputs.alerts import AlertRules
from app.web.readings import messages_of
from config.output_schema import AlertSection
from estimators.errors import ConfigError
from estimators.fleet.fleet import Fleet
from estimators.models import MODELS
from estimators.track import HEALTH_NAMES
from tests.app.outputs.test_alerts import state
from tests.cases import cases
from tests.support import error_of
from tests.waiting import wait_for

BEGIN, SECOND = 1_767_225_600 * 10**9, 10**9
EMPTY = Fleet("kf", MODELS["motor_winding"], assets=1).table()


def table(health, causes=()):
    """A table of assets of these grades of health."""
    count = len(health)
    columns = {
        name: np.zeros((count, *column.shape[1:]), column.dtype)
        for name, column in zip(EMPTY._fields[1:], EMPTY[1:], strict=True)
    }
    columns["health"] = np.array([HEALTH_NAMES.index(name) for name in health], np.int8)
    columns["cause"] = np.array([*causes, *[""] * (count - len(causes))])
    return EMPTY._replace(assets=names(count), **columns)


def names(count):
    return [f"pump {k}" for k in range(count)]


class Looked:
    """A rule with a clock of its own."""

    def __init__(self, **rule):
        self.now = 0.0
        self.rules = FleetRules([FleetAlertSection(**rule)], "pumps", link="http://x", clock=lambda: self.now)

    def at(self, t, *health, causes=()):
        """The message that is due at a time, None if there is none."""
        self.now = t
        found = self.rules.look(names(len(health)), table(health, causes))
        return found[0][1] if found else None


@pytest.mark.parametrize(("after", "clear"), [(0.0, 0.0), (3.0, 0.0), (0.0, 4.0), (3.0, 5.0)])
def test_each_asset_fires_and_recovers_when_a_twin_would(after, clear):
    rng, assets, times = np.random.default_rng(7), 20, 300
    grades = ("tracking", "suspect", "degraded", "stale")
    rules = Looked(health="degraded", after=after, clear=clear, group=0.0, repeat="never")
    single, clock = {}, SimpleNamespace(now=0.0)
    present = ["tracking"] * assets
    for k in range(times):
        t = clock.now = float(k)
        present = [grades[rng.integers(4)] if rng.random() < 0.25 else grade for grade in present]
        known = assets // 2 if k < times // 2 else assets  # others come later
        message = rules.at(t, *present[:known])
        found: dict[str, set[str]] = {"firing": set(), "resolved": set()}
        for name, grade in zip(names(known), present, strict=False):
            one = single.setdefault(name, AlertRules(
                [AlertSection(health="degraded", after=after, clear=clear, repeat="never")], clock=lambda: clock.now
            ))  # fmt: skip
            for _, alert in one.look(SimpleNamespace(mute=None, episodes=list), state(health=grade)):
                found[alert.status].add(name)
        assert (message is not None) == any(found.values())
        if message is not None:
            assert set(message.fired) == found["firing"] and set(message.recovered) == found["resolved"]
            in_alarm = {name for name, one in single.items() if one.open}
            assert {item.asset for item in message.assets} == in_alarm and message.value == len(in_alarm)
            wanted = "firing" if message.fired else "repeated" if in_alarm else "resolved"
            assert message.status == wanted


def test_many_assets_are_one_message_and_further_ones_wait_for_the_next():
    rules, bad, good = (
        Looked(health="degraded", after=1.0, clear=5.0, group=30.0, repeat=3600.0),
        "degraded",
        "tracking",
    )
    assert rules.at(0.0, *["stale"] * 3, *[bad] * 297, good) is None
    first = rules.at(1.0, *["stale"] * 3, *[bad] * 297, good, causes=["stale"] * 3 + ["silent"] * 297)
    assert (first.status, first.value, first.health, first.subject) == ("firing", 300.0, "stale", "300 assets")
    assert [item.asset for item in first.assets] == names(MAX_LISTED) and [*first.fired] == names(MAX_LISTED)
    assert first.text == (
        "300 assets degraded or worse, 300 new: pump 0 (stale), pump 1 (stale), pump 2 (stale), "
        "pump 3 (degraded, silent), pump 4 (degraded, silent) and 295 more"
    )
    assert first.guide == "docs/alarms.md#stale" and "source" in first.response and first.link == "http://x"
    assert rules.at(5.0, *[bad] * 301) is None and rules.at(30.9, *[bad] * 301) is None
    second = rules.at(31.0, *[bad] * 301)
    assert (second.status, second.value, second.id) == ("firing", 301.0, first.id) and second.fired == ("pump 300",)
    assert second.text.startswith("301 assets degraded or worse, 1 new: pump 300 (degraded), pump 0 (degraded)")
    assert rules.at(40.0, bad, *[good] * 300) is None and rules.at(61.0, bad, *[good] * 300).status == "repeated"
    assert rules.at(3000.0, bad, *[good] * 300) is None
    again = rules.at(3661.0, bad, *[good] * 300)
    assert (again.status, again.fired, again.recovered, again.subject) == ("repeated", (), (), "pump 0")
    last = rules.at(3700.0, *[good] * 301)
    assert (last.status, last.recovered, last.value, last.id) == ("resolved", ("pump 0",), 0.0, first.id)
    assert last.text == "no asset is degraded or worse any longer; 1 asset recovered"
    assert rules.at(9000.0, *[good] * 301) is None
    rules.at(9001.0, bad, *[good] * 300)
    assert rules.at(9002.0, bad, *[good] * 300).id != first.id


def test_an_asset_that_recovers_before_it_was_in_a_message_is_in_none():
    rules = Looked(health="degraded", after=0.0, clear=0.0, group=30.0)
    assert rules.at(0.0, "degraded", "tracking").fired == ("pump 0",)
    assert rules.at(1.0, "degraded", "degraded") is None
    assert rules.at(2.0, "degraded", "tracking") is None
    assert rules.at(40.0, "degraded", "tracking") is None


def started(folder, outputs, alerts=()):
    path = folder / "pumps.yaml"
    given = {"twin": "motor_winding", "source": {"type": "push"}, "outputs": outputs, "alerts": [*alerts]}
    path.write_text(json.dumps(given))
    return RunningFleet(load_fleet(path), lambda *_: None, threads=1)


def test_silent_assets_are_one_alert_of_a_receiver_which_is_resolved(tmp_path, hook, capsys):
    rule = {"health": "degraded", "after": 0, "clear": 0, "group": 0}
    fleet = started(tmp_path, {"every": 0.05, "receivers": {"log": hook.section}}, [rule])
    publisher, source = FleetPublisher(fleet, page="http://127.0.0.1:1"), messages_of(fleet)

    def send(first, last, assets):
        source.send([
            {"time": BEGIN + k * SECOND, "asset": f"pump {a}", "values": {"winding": 40.0 + 2.0 * (-1) ** k}}
            for k in range(first, last) for a in assets
        ])  # fmt: skip
        fleet.clock = lambda: BEGIN + last * SECOND
        fleet.step()

    send(0, 30, range(5))
    publisher.start()
    try:
        send(30, 41, [0, 1])  # the others have been silent for 12 s
        fleet.step()
        wait_for(lambda: len(hook.alerts) == 1)
        (alert,) = hook.alerts
        assert {key: alert[key] for key in ("twin", "status", "rule", "value", "unit")} == {
            "twin": "pumps", "status": "firing", "rule": "health-degraded", "value": 3.0, "unit": "assets",
        }  # fmt: skip
        assert alert["fired"] == ["pump 2", "pump 3", "pump 4"]
        assert {item["cause"] for item in alert["assets"]} == {"silent"}
        send(41, 42, range(5))
        wait_for(lambda: len(hook.alerts) == 2)
        assert hook.alerts[1]["status"] == "resolved" and len(hook.alerts[1]["recovered"]) == 3
    finally:
        publisher.stop()
        fleet.stop()
    assert "alert firing: 3 assets degraded or worse, 3 new: pump 2 (degraded, silent)" in capsys.readouterr().err


def test_a_fleet_that_stands_still_does_not_tell_that_it_runs(tmp_path):
    fleet = started(tmp_path, {"every": 0.01, "receivers": {"log": {"type": "webhook", "url": "http://127.0.0.1:1"}}})
    publisher, source, beats = FleetPublisher(fleet), messages_of(fleet), []
    publisher._deliveries.beat = lambda *_: beats.append(1)
    source.send([{"asset": "a", "values": {"winding": 40.0}}])
    fleet.step()
    publisher.start()
    try:
        wait_for(lambda: len(beats) > 3)
        fleet.step = lambda: 1 / 0
        fleet.start()
        wait_for(lambda: fleet.failure)
        before = len(beats)
        looks = []
        fleet.table, table = (lambda: looks.append(1) or table()), fleet.table
        wait_for(lambda: len(looks) > 3)
    finally:
        publisher.stop()
        fleet.stop()
    assert len(beats) <= before + 1  # one look may be under way


@cases(__file__, "refused_alerts.csv")
def test_a_wrong_rule_or_receiver_is_one_line(outputs, alerts, text, tmp_path):
    said = error_of(ConfigError, started, tmp_path, json.loads(outputs), json.loads(alerts))
    assert text in said and "pumps.yaml:1" in said
