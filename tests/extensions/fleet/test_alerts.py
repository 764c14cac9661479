"""Alerts of fleets: an asset is in alarm as a twin would be, those of a moment are one message; after a restart too."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from app.engine.outputs.alerts import SETTLE_S, AlertRules
from app.engine.store import Store
from app.extensions.fleet.alerts import MAX_ABSENCE_S, MAX_LISTED, FleetRules
from app.extensions.fleet.publisher import FleetPublisher
from app.extensions.fleet.schema import FleetAlertSection
from app.web.readings import messages_of
from config.output_schema import AlertSection
from estimators.errors import ConfigError
from estimators.fleet.fleet import Fleet
from estimators.models import MODELS
from estimators.track import HEALTH_NAMES
from tests.app.engine.outputs.test_alert_store import restarted
from tests.app.engine.outputs.test_alerts import state
from tests.cases import cases
from tests.extensions.fleet.test_running import fleet_of, running
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
        found = self.rules.evaluate(names(len(health)), table(health, causes))
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
            for _, alert in one.evaluate(SimpleNamespace(mute=None, episodes=list), state(health=grade)):
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


def test_silent_assets_are_one_alert_of_a_receiver_which_is_resolved(tmp_path, hook, capsys):
    rule = {"health": "degraded", "after": 0, "clear": 0, "group": 0}
    outputs = {"every": 0.05, "receivers": {"log": hook.section}}
    fleet, _ = running(tmp_path, outputs=outputs, alerts=[rule])
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
    receivers = {"log": {"type": "webhook", "url": "http://127.0.0.1:1"}}
    fleet, _ = running(tmp_path, outputs={"every": 0.01, "receivers": receivers})
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
    given = {"outputs": json.loads(outputs), "alerts": json.loads(alerts)}
    said = error_of(ConfigError, running, tmp_path, **given)
    assert text in said and "pumps.yaml:1" in said


def test_assets_in_alarm_are_known_after_a_restart_in_any_order():
    rule = {"health": "degraded", "after": 5.0, "clear": 10.0, "group": 0.0, "repeat": 3600.0}
    bad, good = "degraded", "tracking"
    before = Looked(**rule)
    assert before.at(0.0, bad, bad, good, bad) is None
    first = before.at(5.0, bad, bad, good, bad)
    before.now = 105.0
    after = restarted(before, 500.0, at=50.0, make=Looked, **rule)

    def at(t, **health):
        """Look at assets that come in another order than before."""
        after.now = t
        names = [name.replace("_", " ") for name in health]
        found = after.rules.evaluate(names, table(list(health.values()))._replace(assets=names))
        return found[0][1] if found else None

    # Parts of the fleet start one after another; one does not report any more.
    assert at(50.0, pump_1=bad) is None
    assert at(60.0, pump_1=bad, pump_2=good, pump_0=good) is None
    # One has recovered 10 s after that, which waits for the other one, or for the next message.
    assert at(85.0, pump_1=bad, pump_2=good, pump_0=good) is None
    assert at(90.0, pump_1=bad, pump_2=bad, pump_0=good) is None
    message = at(95.0, pump_1=bad, pump_2=bad, pump_0=good)
    assert (message.status, message.id, message.since) == ("firing", first.id, first.since)
    assert (message.fired, message.recovered, message.value) == (("pump 2",), ("pump 0",), 3.0)
    message = at(50.0 + MAX_ABSENCE_S, pump_1=bad, pump_2=bad, pump_0=good)
    assert (message.status, message.id, message.value) == ("repeated", first.id, 2.0)
    assert message.recovered == ("pump 3",) and message.text.endswith("; 1 asset recovered")
    assert at(200.0, pump_1=good, pump_2=good, pump_0=good).status == "resolved"
    assert not after.rules.state()
    # An asset that is new, before any other is known again, belongs to the same alert.
    after = restarted(before, 0.0, make=Looked, **rule)
    assert at(0.0, pump_9=bad) is None and at(5.0, pump_9=bad).id == first.id


def test_a_fleet_repeats_and_resolves_after_a_restart():
    rule = {"health": "degraded", "after": 0.0, "clear": 0.0, "group": 0.0, "repeat": 60.0}
    before = Looked(**rule)
    first = before.at(0.0, "degraded", "tracking")
    after = restarted(before, 40.0, make=Looked, **rule)
    assert after.at(0.0, "degraded", "tracking") is None and after.at(19.0, "degraded", "tracking") is None
    again = after.at(20.0, "degraded", "tracking")
    assert (again.status, again.id, again.fired) == ("repeated", first.id, ())
    # Without the state of the assets, nothing is known of one that has not reported.
    later = restarted(after, 0.0, make=Looked, **rule)
    assert later.at(0.0, "waiting", "waiting") is None and later.at(50.0, "waiting", "tracking") is None
    assert later.at(59.0, "tracking", "tracking") is None
    last = later.at(50.0 + SETTLE_S, "tracking", "tracking")
    assert (last.status, last.id, last.recovered) == ("resolved", first.id, ("pump 0",))
    other = restarted(after, 0.0, make=Looked, health="stale", group=0.0)
    assert other.at(0.0, "degraded", "tracking") is None
    last = other.at(SETTLE_S + 10.0, "degraded", "tracking")
    assert (last.status, last.id, last.text) == ("resolved", first.id, "the rule health-degraded was removed")
    assert not other.rules.state()


def test_a_fleet_resolves_after_a_restart_with_its_assets_in_another_order(tmp_path, hook, monkeypatch):
    monkeypatch.setattr("app.extensions.fleet.alerts.SETTLE_S", 0.0)
    outputs = {"every": 0.02, "receivers": {"log": hook.section}}
    plan = fleet_of(tmp_path, outputs=outputs, alerts=[{"health": "degraded", "after": 0, "clear": 0, "group": 0}])

    def run(names, health, count):
        now = table(health)._replace(assets=names)
        store = Store(tmp_path / "pumps.store")
        publisher = FleetPublisher(SimpleNamespace(plan=plan, failure="", table=lambda: (1, names, now), file=store))
        publisher.start()
        try:
            wait_for(lambda: len(hook.alerts) == count)
        finally:
            publisher.stop()
            store.close()

    run(["a", "b", "c"], ["degraded", "tracking", "stale"], 1)
    run(["c", "a", "b", "d"], ["tracking", "tracking", "tracking", "degraded"], 2)
    run(["d", "b", "c", "a"], ["tracking"] * 4, 3)
    alerts = hook.alerts
    assert [alert["status"] for alert in alerts] == ["firing", "firing", "resolved"]
    assert len({alert["id"] for alert in alerts}) == 1
    assert (alerts[1]["fired"], alerts[1]["recovered"]) == (["d"], ["c", "a"])
    assert not np.isin(["a", "b", "c"], alerts[2]["recovered"]).any()
