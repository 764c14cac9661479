"""Sparkplug B at a real broker, read by Google's protobuf from the published description of its messages."""

import re

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from app.outputs.sparkplug import SparkplugNode
from estimators.errors import ConfigError
from estimators.track import HEALTH_NAMES
from tests.app.outputs.broker import Listener
from tests.app.outputs.test_alerts import state
from tests.app.outputs.test_mqtt import BEGIN, broker, published, push  # noqa: F401  a fixture
from tests.app.scripted import pull_all
from tests.support import SECOND
from tests.waiting import wait_for

PROTO = """
PropertyValue: uint32 type 1, bool is_null 2, uint32 int_value 3, uint64 long_value 4, float float_value 5,
    double double_value 6, bool boolean_value 7, string string_value 8
PropertySet: string* keys 1, PropertyValue* values 2
Metric: string name 1, uint64 alias 2, uint64 timestamp 3, uint32 datatype 4, bool is_historical 5, bool is_transient 6,
    bool is_null 7, PropertySet properties 9, uint32 int_value 10, uint64 long_value 11, float float_value 12,
    double double_value 13, bool boolean_value 14, string string_value 15, bytes bytes_value 16
Payload: uint64 timestamp 1, Metric* metrics 2, uint64 seq 3, string uuid 4, bytes body 5
"""
"""Fields of sparkplug_b.proto (proto2), * for repeated ones; those of no metric here are left out."""

GROUP = "plant"
INT32, INT64, DOUBLE, BOOLEAN, STRING = 3, 4, 10, 11, 12


def payload_class():
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b.proto", package="spb", syntax="proto2")
    for name, fields in re.findall(r"(\w+): ((?:[^:]|\n)*?)(?=\n\w+:|\Z)", PROTO):
        message = file.message_type.add(name=name)
        for kind, repeated, field, number in re.findall(r"(\w+)(\*?) (\w+) (\d+)", fields):
            added = message.field.add(name=field, number=int(number), label=3 if repeated else 1)
            if kind[0].isupper():
                added.type, added.type_name = 11, f".spb.{kind}"
            else:
                added.type = getattr(added, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("spb.Payload"))


Payload = payload_class()


def parsed(payload):
    message = Payload.FromString(payload)
    # What the description lacks would be kept aside, and written again.
    known = Payload.FromString(payload)
    known.DiscardUnknownFields()
    assert known.SerializeToString() == message.SerializeToString() and len(message.SerializeToString()) == len(payload)
    return message


def properties(metric):
    assert len(metric.properties.keys) == len(metric.properties.values)
    return dict(zip(metric.properties.keys, metric.properties.values, strict=True))


def quality(metric):
    found = properties(metric)["Quality"]
    assert found.type == INT32 and found.HasField("int_value")
    return found.int_value


def value(metric):
    """The value in the field of its kind; None for one that is null."""
    fields = [field.name for field, _ in metric.ListFields() if field.name.endswith("_value")]
    assert len(fields) == (not metric.is_null)
    return getattr(metric, fields[0]) if fields else None


class Host:
    """A host application: all messages of the group in their order."""

    def __init__(self, broker):  # noqa: F811
        self.heard = []
        self.listener = Listener(broker)
        self.listener.client.message_callback_add("spBv1.0/#", lambda _client, _data, item: self.heard.append(item))

    def of(self, kind):
        topic = f"spBv1.0/{GROUP}/{kind}/motor_winding"
        return [parsed(item.payload) for item in self.heard.copy() if item.topic == topic]

    def data(self, *, historical=False):
        """Metrics of all NDATA."""
        return [m for p in self.of("NDATA") for m in p.metrics if m.is_historical == historical]

    def command(self, *metrics, body=None):
        payload = Payload(timestamp=1)
        for metric in metrics:
            payload.metrics.add(**metric)
        body = payload.SerializeToString() if body is None else body
        self.listener.publish(f"spBv1.0/{GROUP}/NCMD/motor_winding", body)


@pytest.fixture
def host(broker):  # noqa: F811
    made = Host(broker)
    yield made
    made.listener.stop()


@pytest.fixture
def page(serve, broker, host):  # noqa: F811
    mqtt = {"host": "127.0.0.1", "port": broker.port, "sparkplug": GROUP}
    made = published(serve, broker, outputs={"mqtt": mqtt})
    yield made
    made.engine.published.stop()


def by_name(birth):
    return {metric.name: metric for metric in birth.metrics}


def bdseq(payload):
    (found,) = [metric for metric in payload.metrics if metric.name == "bdSeq"]
    assert found.datatype == INT64 or not found.HasField("datatype")
    return found.long_value


def test_birth_declares_what_data_carry_and_these_are_the_state(page, host):
    wait_for(lambda: host.of("NBIRTH"))
    (birth,) = host.of("NBIRTH")
    metrics = by_name(birth)
    states = page.engine.model.shown_states
    names = [name for s in states for name in (f"state/{s.name}", f"state/{s.name}/std")]
    assert list(metrics) == ["bdSeq", "Node Control/Rebirth", *names, "health", "cause", "revision"]
    assert birth.seq == 0 and birth.HasField("seq") and bdseq(birth) == 0
    rebirth = metrics["Node Control/Rebirth"]
    assert (rebirth.datatype, rebirth.boolean_value) == (BOOLEAN, False) and rebirth.HasField("boolean_value")
    assert not rebirth.HasField("alias") and not metrics["bdSeq"].HasField("alias")
    aliases = {metric.alias: metric.name for metric in birth.metrics if metric.HasField("alias")}
    assert sorted(aliases.values()) == sorted([*names, "health", "cause", "revision"])
    assert all(metric.HasField("timestamp") and metric.HasField("datatype") for metric in birth.metrics)
    for s in states:
        for name in (f"state/{s.name}", f"state/{s.name}/std"):
            unit = properties(metrics[name])["engUnit"]
            assert (metrics[name].datatype, unit.type, unit.string_value) == (DOUBLE, STRING, s.unit)
            assert (value(metrics[name]), quality(metrics[name])) == (None, 0)  # Nothing was measured yet

    for k, winding in enumerate((41.0, 42.0, 41.5)):
        push(page, (k, winding))
        at = BEGIN // 10**6 + 1000 * k
        wait_for(lambda at=at: len([m for m in host.data() if m.timestamp == at]) >= len(names))
    served = page.get("/api/state")
    assert served["time_ns"] == BEGIN + 2 * SECOND
    last = {}
    for metric in host.data():
        assert not metric.HasField("name") and not metric.HasField("datatype") and metric.HasField("timestamp")
        last[aliases[metric.alias]] = metric
    for s in served["states"]:
        for name, wanted in ((f"state/{s['name']}", s["value"]), (f"state/{s['name']}/std", s["std"])):
            assert (value(last[name]), quality(last[name])) == (wanted, 192)
            assert last[name].timestamp == BEGIN // 10**6 + 2000
    assert value(last["health"]) == served["health"]
    assert [payload.seq for payload in host.of("NDATA")] == list(range(1, len(host.of("NDATA")) + 1))
    assert host.data(historical=True) == []
    kinds = {item.topic.split("/")[2]: (item.qos, item.retain) for item in host.heard}
    assert kinds == {"NBIRTH": (0, False), "NDATA": (0, False)}


def test_a_lost_connection_ends_with_the_death_of_its_birth_and_the_next_has_another_number(page, host):
    wait_for(lambda: host.of("NBIRTH"))
    (mqtt,) = page.engine.published.outputs
    for number in range(2):
        mqtt.client.socket().shutdown(2)  # As of a process that is killed
        wait_for(lambda number=number: len(host.of("NBIRTH")) == number + 2)
    order = [
        (item.topic.split("/")[2], bdseq(parsed(item.payload))) for item in host.heard if "NDATA" not in item.topic
    ]
    # The broker may take the new connection before it has noticed the end of the old one.
    assert [number for kind, number in order if kind == "NBIRTH"] == [0, 1, 2]
    wait_for(lambda: [bdseq(payload) for payload in host.of("NDEATH")] == [0, 1])
    assert not any(payload.HasField("seq") for payload in host.of("NDEATH"))
    page.engine.published.stop()
    wait_for(lambda: [bdseq(payload) for payload in host.of("NDEATH")] == [0, 1, 2])


def test_a_command_has_the_birth_repeated_and_any_other_is_reported(page, host):
    push(page, (0, 41.0))
    wait_for(host.data)
    host.command({"name": "Node Control/Rebirth", "boolean_value": True})
    wait_for(lambda: len(host.of("NBIRTH")) == 2)
    birth = host.of("NBIRTH")[-1]
    assert (birth.seq, bdseq(birth)) == (0, 0)
    assert value(by_name(birth)[f"state/{page.engine.model.shown_states[0].name}"]) is not None
    host.command({"name": "Node Control/Rebirth", "boolean_value": False})
    for body in (b"\xff" * 20, b"\x12\xff\x01", b"hello", b""):
        host.command(body=body)
    host.command({"name": "Node Control/Reboot", "boolean_value": True})
    push(page, (1, 41.5))
    wait_for(lambda: host.of("NDATA")[-1].metrics[0].timestamp == BEGIN // 10**6 + 1000)
    wait_for(lambda: page.engine.notices.counts().get("output mqtt command") == 5)
    lines = [line.text for line in page.engine.notices.since(0) if "a command" in line.text]
    assert lines[0] == (
        f"output mqtt: a command at spBv1.0/{GROUP}/NCMD/motor_winding is ignored: it is no payload of Sparkplug B"
    )
    assert len(host.of("NBIRTH")) == 2


def test_after_a_refold_the_earlier_states_are_sent_again_as_historical(page, host):
    for k in range(6):
        push(page, (k, 40.0 + k))
        at = BEGIN // 10**6 + 1000 * k
        wait_for(lambda at=at: any(metric.timestamp == at for metric in host.data()))
    before = pull_all(page.engine)
    command = {"command": "SetTuning", "key": "R.winding", "value": 25.0}
    assert page.client.post("/api/command", command).status == 202
    wait_for(lambda: host.data(historical=True))
    rows = pull_all(page.engine)
    assert rows.revision > before.revision and (rows.track.mean[-2] != before.track.mean[-2]).any()
    aliases = {metric.alias: metric.name for metric in host.of("NBIRTH")[0].metrics}
    found = {(aliases[m.alias], m.timestamp): m for m in host.data(historical=True)}
    times = [BEGIN + k * SECOND for k in range(5)]
    names = [s.name for s in page.engine.model.shown_states]
    assert len(found) == len(times) * 2 * len(names)
    for t in times:
        (i,) = [i for i, other in enumerate(rows.events.t) if other == t]
        for j, name in enumerate(names):
            for metric, column in ((f"state/{name}", rows.track.mean), (f"state/{name}/std", rows.track.std)):
                item = found[metric, t // 10**6]
                assert (value(item), quality(item)) == (column[i, j], 192)
    # The present state is no history.
    now = [m for m in host.data() if aliases[m.alias] == "revision"][-1]
    assert value(now) == rows.revision and now.timestamp == (BEGIN + 5 * SECOND) // 10**6


class Engine:
    """As much of a running twin as a node needs without history."""

    def __init__(self, name="motor"):
        self.twin = type("Twin", (), {"name": name})


def test_numbers_go_from_0_to_255_and_begin_again():
    node = SparkplugNode(GROUP, Engine())
    assert node.states(state(1.0)) == [], "no data before the birth"
    seqs = [parsed(node.births(state(0.5))[0].payload).seq]
    for k in range(600):
        (packet,) = node.states(state(1.0 + k))
        seqs.append(parsed(packet.payload).seq)
    assert seqs == [k % 256 for k in range(601)]
    numbers = []
    for _ in range(300):
        numbers.append(bdseq(parsed(node.will().payload)))
        assert bdseq(parsed(node.will().payload)) == numbers[-1], "an attempt that had no birth takes no number"
        assert bdseq(parsed(node.births(state(1.0))[0].payload)) == numbers[-1]
    assert numbers == [(k + 1) % 256 for k in range(300)]
    assert node.states(state(1.0)) == [], "only changes are sent"
    node.lost()
    assert node.states(state(2.0)) == [], "no data between two connections"


@pytest.mark.parametrize("health", HEALTH_NAMES)
def test_quality_is_one_of_three_numbers(health):
    valid = health in ("tracking", "advisory", "suspect", "degraded")
    node = SparkplugNode(GROUP, Engine())
    message = state(100.0 if valid else None, health=health, estimate_valid=valid)
    found = by_name(parsed(node.births(message)[0].payload))
    wanted = 192 if valid else 500 if health == "stale" else 0
    assert [quality(found[name]) for name in ("state/winding", "state/winding/std")] == [wanted] * 2
    assert value(found["state/winding"]) == (100.0 if valid else None)
    assert (value(found["health"]), quality(found["health"])) == (health, 192)


def test_a_model_with_other_states_is_born_again():
    node = SparkplugNode(GROUP, Engine())
    first = state(1.0)
    node.births(first)
    other = first.model_copy(update={"states": (first.states[0].model_copy(update={"name": "rotor"}),)})
    (packet,) = node.states(other)
    assert packet.topic == f"spBv1.0/{GROUP}/NBIRTH/motor" and "state/rotor" in by_name(parsed(packet.payload))


def test_a_twin_whose_name_is_no_part_of_a_topic_is_refused():
    with pytest.raises(ConfigError, match="the twin's name 'a/b' has one of"):
        SparkplugNode(GROUP, Engine("a/b"))
