"""States and alerts of a fleet over MQTT: a topic for each asset, and only what has changed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.engine.outputs.state_message import StateMessage
from app.extensions.fleet.publisher import FleetPublisher
from app.extensions.fleet.state import ChangedAssets, asset_message
from app.twin.twin import load_twin
from app.web.readings import messages_of
from estimators.track import HEALTH_NAMES
from tests.extensions.fleet.test_alerts import table
from tests.extensions.fleet.test_running import folded, running
from tests.extensions.mqtt.broker import Listener
from tests.waiting import wait_for

BEGIN, SECOND = 1_767_225_600 * 10**9, 10**9
ASSETS = ("pump 1", "hall/pump+2", "50 %")
LEVELS = ("pump 1", "hall%2Fpump%2B2", "50 %25")


def started(folder, broker, **more):
    mqtt = {"host": "127.0.0.1", "port": broker.port}
    outputs = {"every": 0.05, "mqtt": mqtt, "receivers": {"broker": {"type": "mqtt"}}}
    return running(folder, outputs=outputs, **more)[0]


def send(fleet, first, last, assets):
    sent = [
        {"time": BEGIN + k * SECOND, "asset": asset, "values": {"winding": 40.0 + k + j}}
        for k in range(first, last) for j, asset in enumerate(assets)
    ]  # fmt: skip
    assert {item.status for item in messages_of(fleet).send(sent)} == {"accepted"}
    fleet.clock = lambda: BEGIN + last * SECOND
    fleet.step()


def test_each_asset_that_changed_is_published_with_the_estimate_of_its_own_fold(tmp_path, broker, listener):
    fleet = started(tmp_path, broker)
    publisher = FleetPublisher(fleet)
    send(fleet, 0, 5, ASSETS)
    publisher.start()

    def states(level):
        return listener.of(f"nisus/pumps/{level}/state")

    try:
        wait_for(lambda: all(map(states, LEVELS)))
        for j, (asset, level) in enumerate(zip(ASSETS, LEVELS, strict=True)):
            (message,) = states(level)
            last = folded([40.0 + k + j for k in range(5)])
            assert StateMessage(**message).twin == asset and message["time_ns"] == BEGIN + 4 * SECOND
            assert message["time"] == "2026-01-01T00:00:04.000000Z"
            assert [item["value"] for item in message["states"]] == last.mean.tolist()
            assert [item["std"] for item in message["states"]] == last.std.tolist()
            assert (message["health"], message["age_s"]) == (HEALTH_NAMES[last.health], 0.0)
            assert message["nis"] == pytest.approx(float(last.nis_mean), rel=1e-12)
        send(fleet, 5, 7, ASSETS[:1])
        wait_for(lambda: len(states(LEVELS[0])) == 2)
        assert states(LEVELS[0])[1]["time_ns"] == BEGIN + 6 * SECOND
        assert [len(states(level)) for level in LEVELS] == [2, 1, 1]
        birth, status = (listener.of(f"nisus/pumps/{name}")[-1] for name in ("birth", "status"))
        assert [item["name"] for item in birth["states"]] == ["temperature", "rate"] and status["online"]
        later = Listener(broker)
        wait_for(lambda: len({topic for topic, _, retain in later.heard if retain and topic.endswith("state")}) == 3)
        later.stop()
        broker.stop()
        send(fleet, 7, 8, ASSETS[:1])
        broker.start()  # without what it had
        again = Listener(broker)
        wait_for(lambda: all(again.of(f"nisus/pumps/{level}/state") for level in LEVELS))
        assert again.of(f"nisus/pumps/{LEVELS[0]}/state")[-1]["time_ns"] == BEGIN + 7 * SECOND
        again.stop()
    finally:
        publisher.stop()
        fleet.stop()


def test_alerts_are_published_under_the_fleet(tmp_path, broker, listener):
    fleet = started(tmp_path, broker, alerts=[{"health": "degraded", "after": 0}])
    publisher = FleetPublisher(fleet)
    send(fleet, 0, 30, ASSETS)
    publisher.start()
    try:
        send(fleet, 30, 41, ASSETS[:1])
        fleet.step()
        wait_for(lambda: listener.of("nisus/pumps/alert"))
        (alert,) = listener.of("nisus/pumps/alert")
        assert alert["status"] == "firing" and {*alert["fired"]} == {*ASSETS[1:]}
    finally:
        publisher.stop()
        fleet.stop()
    wait_for(lambda: not listener.of("nisus/pumps/status")[-1]["online"])


def test_a_state_that_is_not_known_has_no_number():
    twin = load_twin("motor_winding")
    known = table(["stale", "tracking", "waiting"], ["stale"])
    known = known._replace(seconds=np.array([1.0, 2.0, np.nan]), age=np.array([60.0, 0.0, np.nan]))
    stale, good, waiting = (asset_message(twin, f"pump {k}", known, k) for k in range(3))
    assert [item.value for item in stale.states] == [None, None] and stale.states[0].reason == "stale"
    assert (stale.age_s, stale.time_ns, stale.time, stale.estimate_valid) == (60.0, SECOND, None, False)
    assert [item.value for item in good.states] == [0.0, 0.0] and good.estimate_valid
    assert (waiting.time_ns, waiting.age_s) == (None, None)
    assert waiting.states[0].reason == "the twin is waiting"
    wide = known._replace(std=np.array([[0.0, 0.0], [1.0, 1.1], [0.0, 0.0]]))
    limits = [replace(state, withhold=2.0) for state in twin.model.shown_states]  # of the half-width, 1.96 σ
    model = SimpleNamespace(shown_states=limits, sensors=twin.model.sensors, ny=1)
    message = asset_message(replace(twin, model=model), "pump 1", wide, 1)
    assert [item.reason for item in message.states] == ["", "too uncertain"] and not message.estimate_valid


def test_those_that_waited_longest_are_published_first():
    changed, known = ChangedAssets(), table(["tracking"] * 5)
    known = known._replace(seconds=np.array([1.0, 1.0, 1.0, 1.0, np.nan]))  # one without a measurement
    changed.update(known)
    assert changed.pop(3) == [0, 1, 2]
    changed.update(known._replace(events=np.array([1, 0, 1, 0, 0])))
    assert changed.pop(3) == [3, 4, 0] and changed.pop(9) == [2] and changed.pop(9) == []
    changed.update(known._replace(events=np.array([1, 0, 1, 0, 0]), health=known.health + np.int8(0)))
    assert changed.pop(9) == []
    more = table(["tracking"] * 4 + ["stale"] * 2)._replace(
        events=np.array([1, 0, 1, 0, 0, 0]), seconds=np.append(known.seconds, np.nan)
    )
    changed.update(more)
    assert changed.pop(0) == [] and changed.pop(9) == [5, 4]
