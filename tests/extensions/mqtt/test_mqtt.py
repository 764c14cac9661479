"""MQTT at a real broker: states and alerts out, measurements in, and a broker that goes and comes back."""

import json
from contextlib import contextmanager
from types import SimpleNamespace

import jsonschema
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from app.engine.outputs.state_message import state_schema
from app.extensions.mqtt.source import MqttSource, TopicMap
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from sources.messages import Messages
from sources.source import Channel
from tests.app.engine.outputs.pushed import BEGIN, publishing, push, pushed_twin
from tests.app.scripted import notice_texts
from tests.cases import cases
from tests.extensions.mqtt.broker import Listener
from tests.support import SECOND, free_port
from tests.waiting import wait_for

ROOT = "nisus/motor_winding"


@contextmanager
def published(serve, broker, receivers=None, **more):
    """A served twin while its publisher is connected."""
    outputs = {"every": 0, "mqtt": {"host": "127.0.0.1", "port": broker.port}, "receivers": receivers or {}}
    with publishing(serve, pushed_twin(outputs, **more)) as page:
        wait_for(lambda: page.engine.published.json()["outputs"][0]["connected"])
        yield page


def test_the_state_is_published_with_birth_and_last_will(serve, broker, listener):
    with published(serve, broker) as page:
        push(page, (0, 41.0), (1, 42.0))
        wait_for(lambda: [m for m in listener.of(f"{ROOT}/state") if m["time_ns"] == BEGIN + SECOND])
        served = page.get("/api/state")
        wait_for(lambda: [m for m in listener.of(f"{ROOT}/state") if m["time_ns"] == served["time_ns"]])
        found = next(m for m in listener.of(f"{ROOT}/state") if m["time_ns"] == served["time_ns"])
        jsonschema.validate(found, state_schema())
        changing = ("sent", "age_s", "sensors", "nis", "cause", "health")
        assert {k: v for k, v in found.items() if k not in changing} == {
            k: v for k, v in served.items() if k not in changing
        }
        (birth,) = listener.of(f"{ROOT}/birth")
        assert [(item["name"], item["unit"]) for item in birth["states"]] == [
            (item["name"], item["unit"]) for item in found["states"]
        ]
        assert birth["schema"] == json.loads(json.dumps(state_schema()))
        late = Listener(broker)
        retained = {("birth", True), ("status", True)}
        wait_for(lambda: {(t.rpartition("/")[2], kept) for t, _, kept in late.heard if "state" not in t} == retained)
        assert late.of(f"{ROOT}/status")[0]["online"]
        late.stop()
    wait_for(lambda: not listener.of(f"{ROOT}/status")[-1]["online"])


def test_a_twin_that_is_cut_off_is_told_by_the_broker(serve, broker, listener):
    with published(serve, broker) as page:
        wait_for(lambda: listener.of(f"{ROOT}/status"))
        # As with a process that is killed: the socket ends without a farewell.
        (mqtt,) = page.engine.published._parts.outputs
        mqtt.client.socket().shutdown(2)
        wait_for(lambda: [m["online"] for m in listener.of(f"{ROOT}/status")][:2] == [True, False])


def test_a_broker_that_is_lost_and_back_delays_nothing_and_is_reported(serve, broker):
    alerts = "[{state: temperature, above: 45, after: 0}]"
    with published(serve, broker, {"bus": {"type": "mqtt"}}, alerts=alerts) as page:
        broker.stop()
        wait_for(lambda: not page.get("/api/alerts")["outputs"][0]["connected"])
        push(page, *((k, 50.0) for k in range(30)))
        wait_for(lambda: (page.get("/api/state")["time_ns"] or 0) >= BEGIN + 29 * SECOND)
        wait_for(lambda: page.get("/api/alerts")["receivers"][0]["failing"])
        lines = notice_texts(page.engine)
        assert sum(f"output mqtt: no broker at 127.0.0.1:{broker.port}" in line for line in lines) == 1
        broker.start()
        listener = Listener(broker)
        # The alert waited; the state is the present one, not those of the outage.
        wait_for(lambda: listener.of(f"{ROOT}/alert") and listener.of(f"{ROOT}/state"))
        assert listener.of(f"{ROOT}/alert")[0]["rule"] == "temperature-above"
        assert listener.of(f"{ROOT}/state")[0]["time_ns"] >= BEGIN + 29 * SECOND
        wait_for(lambda: any("connected again" in text for text in notice_texts(page.engine)))
        listener.stop()


def received(serve, broker, topics):
    """A served twin that reads topics of the broker, to which it is connected."""
    source = {"type": "mqtt", "host": "127.0.0.1", "port": broker.port, "topics": topics}
    twin = load_twin("motor_winding", overrides={"source": json.dumps(source), "time.predict_every": "1000"})
    page = serve(twin=twin, behind=lambda report: twin.open_source(page_report))
    wait_for(page.engine.source.inner.connected.is_set)
    return page


def page_report(key, text):
    REPORTED.append((key, text))


REPORTED = []


def test_measurements_come_from_topics_each_once_and_bad_ones_are_missing(serve, broker, listener):
    REPORTED.clear()
    mapped = {"values": {"winding": "data.t"}, "time": "ts", "unit": "ms", "quality": "q", "sequence": "n"}
    page = received(serve, broker, {"plant/number": "winding", "plant/+/json": mapped, "plant/message": None})
    at = BEGIN // 10**6
    listener.publish("plant/a/json", {"data": {"t": 40.0}, "ts": at, "q": "Good", "n": 1})
    listener.publish("plant/a/json", {"data": {"t": 40.0}, "ts": at, "q": "Good", "n": 1})
    listener.publish("plant/a/json", {"data": {"t": 99.0}, "ts": at + 1000, "q": "Bad", "n": 2})
    listener.publish("plant/message", {"time": "2026-01-01T00:00:02Z", "values": {"winding": 41.5}})
    listener.publish("plant/a/json", {"data": {}, "ts": at, "q": "Good", "n": 3})
    listener.publish("plant/a/json", b"\xff")
    wait_for(lambda: page.rows() == 3 and len(REPORTED) == 2)
    found = page.get("/api/state")
    assert found["time_ns"] == BEGIN + 2 * SECOND
    assert (found["sensors"][0]["accepted"], found["sensors"][0]["dropouts"]) == (2, 1)
    assert [text for _, text in REPORTED] == [
        "plant/a/json: the payload has no 'data.t'; it is not used",
        "plant/a/json: the payload is no JSON and no number; it is not used",
    ]


def test_no_retained_payload_without_a_time_is_used_and_a_topic_that_is_refused_is_reported():
    reported = []
    source = MqttSource(
        Messages([Channel(0, 0, "winding", ("winding",), model_units=("°C",))], width=1),
        SimpleNamespace(host="127.0.0.1", port=free_port(), user=None, ca_file=None, client_id=None),
        topics := {"plant/+": TopicMap(), "plant/t": TopicMap(values={"winding": "v"}, time="t")},
        password=None, report=lambda key, text: reported.append(text),
    )  # fmt: skip
    try:
        sent = {"plant/+": {"values": {"winding": 40.0}}, "plant/t": {"v": 40.0, "t": None}}
        for name, topic in topics.items():
            for retain in (True, False):
                payload = json.dumps(sent[name]).encode()
                source._callback(topic)(None, None, SimpleNamespace(topic="plant/t", payload=payload, retain=retain))
        assert len(source.read(0.0)) == 2
        reasons = [ReasonCode(PacketTypes.SUBACK, identifier=code) for code in (135, 1)]
        source._client.on_subscribe(None, None, 1, reasons, None)
        assert [text for text in reported if "refuses" in text] == [
            f"the broker at {source._place} refuses the topic plant/+ (Not authorized); check the rights of the user"
        ]
    finally:
        source.close()


def test_a_source_whose_broker_comes_back_goes_on(serve, broker):
    REPORTED.clear()
    page = received(serve, broker, {"plant/number": "winding"})
    broker.stop()
    wait_for(lambda: REPORTED)
    assert f"no measurements from the broker at 127.0.0.1:{broker.port}" in REPORTED[0][1]
    broker.start()
    wait_for(lambda: page.engine.source.inner.connected.is_set())
    listener = Listener(broker)
    listener.publish("plant/number", "41.0")
    wait_for(lambda: page.rows() == 1)
    listener.stop()


@cases(__file__, "times.csv")
def test_times_in_numbers_are_exact(value, unit, ns):
    topic = TopicMap(values={"a": "v"}, time="t", unit=unit)
    assert topic.message("x", f'{{"v": 1, "t": {value}}}'.encode())["time"] == int(ns)
    assert TopicMap(values={"a": ""}).message("x", b"No Data")["values"] == {"a": "No Data"}


def test_a_receiver_at_the_broker_needs_one():
    with pytest.raises(ConfigError, match="is of type mqtt; give the broker under outputs.mqtt"):
        load_twin("motor_winding", overrides={"outputs": '{"receivers": {"bus": {"type": "mqtt"}}}'})


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"[" * 50_000, "the payload is no JSON and no number"),
        (b'{"v": 1, "pad": "' + b"x" * 2**16 + b'"}', "the payload has 65,555 bytes; at most 65,536 are read"),
        (b'{"w": 1}', "the payload has no 'v'"),
        (b"[1]", "the payload has no 'v'"),
        (b"null", "the payload has no 'v'"),
    ],
)
def test_a_hostile_payload_is_refused_with_the_reason(payload, text):
    with pytest.raises(ValueError, match=text):
        TopicMap(values={"a": "v"}).message("x", payload)


@pytest.mark.parametrize("time", [1e400, -1e400, 1e300, True, "soon", None, [1]])
def test_a_hostile_time_is_left_to_the_check_of_messages(time):
    found = TopicMap(values={"a": "v"}, time="t", unit="s").message("x", json.dumps({"v": 1, "t": time}).encode())
    source = Messages([Channel(0, 0, "a", ("a",), model_units=("m",))], width=1)
    (answer,) = source.send([found])
    # Null is as if there were none; the others are no time.
    assert answer.status == ("accepted" if found["time"] is None else "refused")
