"""Alerts of a fleet after a restart."""

import json
from types import SimpleNamespace

import numpy as np

from app.extensions.fleet.alerts import MAX_ABSENCE_S
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.publisher import FleetPublisher
from app.outputs.alerts import SETTLE_S
from tests.app.outputs.test_alert_store import restarted
from tests.extensions.fleet import test_alerts as of_fleets
from tests.waiting import wait_for


def test_assets_in_alarm_are_known_after_a_restart_in_any_order():
    rule = {"health": "degraded", "after": 5.0, "clear": 10.0, "group": 0.0, "repeat": 3600.0}
    bad, good = "degraded", "tracking"
    before = of_fleets.Looked(**rule)
    assert before.at(0.0, bad, bad, good, bad) is None
    first = before.at(5.0, bad, bad, good, bad)
    before.now = 105.0
    after = restarted(before, 500.0, at=50.0, make=of_fleets.Looked, **rule)

    def at(t, **health):
        """Look at assets that come in another order than before."""
        after.now = t
        names = [name.replace("_", " ") for name in health]
        table = of_fleets.table(list(health.values()))._replace(assets=names)
        found = after.rules.look(names, table)
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
    after = restarted(before, 0.0, make=of_fleets.Looked, **rule)
    assert at(0.0, pump_9=bad) is None and at(5.0, pump_9=bad).id == first.id


def test_a_fleet_repeats_and_resolves_after_a_restart():
    rule = {"health": "degraded", "after": 0.0, "clear": 0.0, "group": 0.0, "repeat": 60.0}
    before = of_fleets.Looked(**rule)
    first = before.at(0.0, "degraded", "tracking")
    after = restarted(before, 40.0, make=of_fleets.Looked, **rule)
    assert after.at(0.0, "degraded", "tracking") is None and after.at(19.0, "degraded", "tracking") is None
    again = after.at(20.0, "degraded", "tracking")
    assert (again.status, again.id, again.fired) == ("repeated", first.id, ())
    # Without the state of the assets, nothing is known of one that has not reported.
    later = restarted(after, 0.0, make=of_fleets.Looked, **rule)
    assert later.at(0.0, "waiting", "waiting") is None and later.at(50.0, "waiting", "tracking") is None
    assert later.at(59.0, "tracking", "tracking") is None
    last = later.at(50.0 + SETTLE_S, "tracking", "tracking")
    assert (last.status, last.id, last.recovered) == ("resolved", first.id, ("pump 0",))
    other = restarted(after, 0.0, make=of_fleets.Looked, health="stale", group=0.0)
    assert other.at(0.0, "degraded", "tracking") is None
    last = other.at(SETTLE_S + 10.0, "degraded", "tracking")
    assert (last.status, last.id, last.text) == ("resolved", first.id, "the rule health-degraded was removed")
    assert not other.rules.state()


def test_a_fleet_resolves_after_a_restart_with_its_assets_in_another_order(tmp_path, hook, monkeypatch):
    monkeypatch.setattr("app.extensions.fleet.alerts.SETTLE_S", 0.0)
    outputs = {"every": 0.02, "receivers": {"log": hook.section}}
    given = {"twin": "motor_winding", "source": {"type": "push"}, "outputs": outputs}
    given["alerts"] = [{"health": "degraded", "after": 0, "clear": 0, "group": 0}]
    (tmp_path / "pumps.yaml").write_text(json.dumps(given))
    plan = load_fleet(tmp_path / "pumps.yaml")

    def run(names, health, count):
        table = of_fleets.table(health)._replace(assets=names)
        fleet = SimpleNamespace(plan=plan, failure="", table=lambda: (1, names, table))
        publisher = FleetPublisher(fleet, store=tmp_path / "pumps.store")
        publisher.start()
        try:
            wait_for(lambda: len(hook.alerts) == count)
        finally:
            publisher.stop()

    run(["a", "b", "c"], ["degraded", "tracking", "stale"], 1)
    run(["c", "a", "b", "d"], ["tracking", "tracking", "tracking", "degraded"], 2)
    run(["d", "b", "c", "a"], ["tracking"] * 4, 3)
    alerts = hook.alerts
    assert [alert["status"] for alert in alerts] == ["firing", "firing", "resolved"]
    assert len({alert["id"] for alert in alerts}) == 1
    assert (alerts[1]["fired"], alerts[1]["recovered"]) == (["d"], ["c", "a"])
    assert not np.isin(["a", "b", "c"], alerts[2]["recovered"]).any()
