"""Fleets of messages, by HTTP and MQTT: each asset has the values of a fold over its own messages."""

import asyncio
import json
import os
import signal
import time
from contextlib import nullcontext
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
from starlette.applications import Starlette

import app.extensions.fleet.running as live
from app.extensions.fleet.api import FleetApi
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from app.extensions.mqtt.source import TopicMap
from app.twin.twin import load_twin
from app.web.readings import READERS, messages_of, routes, send_to, summary
from estimators.errors import NisusError, SourceError
from estimators.log import READING, Events
from estimators.track import HEALTH_NAMES, STALE, USABLE
from sources.messages import FORGOTTEN
from sources.source import NO_ASSET
from tests import ROOT
from tests.app.web.test_readings_api import arrow
from tests.benchmarks.kills import FleetRun, survive_fleet
from tests.cases import cases
from tests.extensions.fleet.test_command import FLEET, write
from tests.skips import program
from tests.support import as_log, error_of, run_python
from tests.waiting import LIMIT_S, wait_for

BEGIN, SECOND = 1_767_225_600 * 10**9, 10**9
PUSH = MappingProxyType({"type": "push"})


def fleet_of(folder, source=PUSH, **more):
    path = folder / "pumps.yaml"
    path.write_text(json.dumps({"twin": "motor_winding", "source": {**source}, **more}))
    return load_fleet(path)


def running(folder, source=PUSH, **more):
    said: list[str] = []
    found = RunningFleet(fleet_of(folder, source, **more), lambda key, text: said.append(text), threads=1)
    return found, said


def message(k, asset, value):
    return {"time": BEGIN + k * SECOND, "asset": asset, "values": {"winding": value}}


def folded(values):
    """The last row of a fold over measurements of one asset, one a second."""
    twin = load_twin("motor_winding")
    t = BEGIN + np.arange(len(values)) * SECOND
    log = as_log(Events.alike(READING, t, np.array(values)))
    fold = twin.fold(log, policy=twin.policy, expected=np.ones(1, np.bool_))
    fold.advance()
    return fold.track.select(fold.n - 1)


@pytest.mark.parametrize("kind", sorted(READERS))
def test_messages_have_the_asset_as_a_field_in_any_form(kind, tmp_path):
    fleet, _ = running(tmp_path)
    source = messages_of(fleet)
    sent = [message(k, asset, 40.0 + k + j) for k in range(6) for j, asset in enumerate(("a", "b/c"))]
    if "arrow" in kind:
        columns = {key: [item[key] for item in sent] for key in ("time", "asset")}
        body = arrow(columns | {"winding": [item["values"]["winding"] for item in sent]})
    elif "ndjson" in kind:
        body = "\n".join(map(json.dumps, sent)).encode()
    else:
        body = json.dumps(sent).encode()
    assert summary(source.send(READERS[kind](body, source.fields)))["accepted"] == 12
    assert fleet.step()
    _, names, table = fleet.table()
    assert names == ["a", "b/c"]
    for j in range(2):
        last = folded([40.0 + k + j for k in range(6)])
        assert table.mean[j].tobytes() == last.mean.tobytes() and table.health[j] == last.health
    fleet.stop()


def test_what_became_of_messages_is_told_by_asset(tmp_path):
    fleet, _ = running(tmp_path)
    source = messages_of(fleet)
    times = [[*range(100, 140)], [138, 140, 101, 102], [10**11]]
    expected = [["used"] * 40, ["late", "used", "stale", "stale"], ["waiting"]]
    for asset in ("a", "b"):
        for at, became in zip(times, expected, strict=True):
            answers = source.send([message(0, asset, 40.0) | {"time": BEGIN + t * SECOND // 100} for t in at])
            assert fleet.outcomes.of(source.accepted, arrivals := np.array([item.arrival for item in answers])) is None
            fleet.step()
            assert fleet.outcomes.of(source.accepted, arrivals) == became
    assert fleet.table()[2].stale.tolist() == [2, 2]
    fleet.stop()


def test_messages_without_the_name_of_an_asset_are_refused(tmp_path):
    fleet, said = running(tmp_path, assets=["a"])
    source = messages_of(fleet)
    wrong = [{"values": {"winding": 1.0}}, message(0, "", 1.0), message(0, 7, 1.0), message(0, "x" * 201, 1.0),
             message(0, "\u200b\t ", 1.0),
             json.loads(json.dumps(message(0, "\ud800", 1.0)))]  # fmt: skip
    found = summary(source.send([*wrong, message(0, "a", 41.0), message(0, "stranger", 41.0)]))
    assert found["refused"] == 6 and "asset is" in found["items"][0]["reason"]
    assert found["items"][4]["reason"] == r"asset is '\u200b\t ', which is blank; give it a visible name"
    assert found["items"][5]["reason"] == r"asset is '\ud800', which has half of a surrogate pair"
    fleet.step()
    assert fleet.table()[1] == ["a"] and fleet.table()[2].events.tolist() == [1]
    assert said == ["pumps.yaml: asset 'stranger' is not among assets; add it to assets"]
    fleet.stop()


class Watch:
    """This machine's time as a test sets it, ns, for the arrival of messages and for the age of assets."""

    def __init__(self, fleet, monkeypatch):
        self.ns = BEGIN
        fleet.clock = self
        monkeypatch.setattr("sources.messages.time", SimpleNamespace(time_ns=self))

    def __call__(self):
        return self.ns


def test_one_more_asset_takes_the_place_of_one_with_a_single_message_or_is_refused(tmp_path):
    fleet, said = running(tmp_path, assets=3)
    source = messages_of(fleet)

    def send(*assets, k=0):
        body = json.dumps([message(k, asset, 40.0) for asset in assets]).encode()
        sent, scope = [], {"type": "http", "method": "POST", "path": "/api/readings", "query_string": b""}
        scope["headers"] = [(b"content-type", b"application/json")]

        async def receive():
            return {"type": "http.request", "body": body}

        async def collect(part):
            sent.append(part)

        asyncio.run(Starlette(routes=routes(fleet))(scope, receive, collect))
        while fleet.step() and source.accepted > source.mark:
            pass
        return sent[0]["status"], json.loads(sent[1]["body"])

    assert send("a", "b", "c")[0] == 200 and fleet.names == ["a", "b", "c"]
    assert send("b", k=1)[0] == 200
    # The clock of one is ahead, so its message is held.
    for name, k in (("d", 2), ("ahead", 10**9), ("e", 3), ("g", 4)):
        assert send(name, k=k)[0] == 200
    assert fleet.names == ["e", "b", "g"] and fleet.counts[FORGOTTEN] == 4 and "'a' is forgotten" in said[0]
    assert fleet._guard.held == 0 and running(tmp_path)[0]._most == 100_000
    table = fleet.table()[2]
    np.testing.assert_array_equal(table.mean, [folded([40.0] * count).mean for count in (1, 2, 1)])
    assert table.events.tolist() == [1, 2, 1]
    # Once each has a second message, none makes room; a batch that has others is not repeated for one refused.
    send("e", "g", k=5)
    status, answer = send("f", k=6)
    assert status == 429 and "as many assets as it may have" in answer["error"] and answer["refused"] == 1
    status, answer = send("b", "f", k=7)
    assert status == 200 and (answer["accepted"], answer["refused"]) == (1, 1)
    assert fleet.names == ["e", "b", "g"] and NO_ASSET not in fleet.counts


def test_an_asset_that_is_silent_becomes_stale_by_the_clock_of_the_receiver(tmp_path, monkeypatch):
    fleet, _ = running(tmp_path)
    source, watch, rng = messages_of(fleet), Watch(fleet, monkeypatch), np.random.default_rng(2)
    for k in range(60):
        watch.ns = BEGIN + k * SECOND
        value = rng.normal(40.0, 2.0)
        source.send([message(k, asset, value) for asset in ("a", "b") if asset == "b" or k < 5])
        fleet.step()
    _, _, table = fleet.table()
    assert HEALTH_NAMES[table.health[0]] == "stale" and table.health[1] in USABLE and table.age[1] == 0.0
    assert table.age[0] == pytest.approx(55.0, abs=3.0)
    fleet.stop()


STEPS_S = (1.0, 60.0, 3600.0, 86_400.0, 315_576_000.0)


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("step", [*STEPS_S, *(-step for step in STEPS_S)])
def test_a_clock_that_was_wrong_for_a_while_costs_its_asset_seconds_and_no_other(step, stored, tmp_path, monkeypatch):
    """Wrong from 10 to 15 s and again from 30 to 45 s, in between a restart; what is sent rises."""
    store = tmp_path / "fleet.db" if stored else None
    fleet = RunningFleet(fleet_of(tmp_path), lambda *_: None, threads=1, store=store)
    source, watch, rng = messages_of(fleet), Watch(fleet, monkeypatch), np.random.default_rng(1)
    for k in range(600):
        if stored and k == 200:
            fleet.step()
            fleet._keep(at_once=True)
            fleet.stop()
            fleet = RunningFleet(fleet_of(tmp_path), lambda *_: None, threads=1, store=store)
            source, fleet.clock = messages_of(fleet), watch
        at = 0.1 * k
        watch.ns = BEGIN + k * SECOND // 10
        wrong = 10.0 <= at < 15.0 or 30.0 <= at < 45.0
        value = rng.normal(40.0 + 0.1 * at, 2.0)
        for name in ("a", "b", "c"):
            off = round(step * SECOND) if wrong and name == "a" else 0
            source.send([{"asset": name, "values": {"winding": value}, "time": watch.ns + off}])
        fleet.step()
        _, _, table = fleet.table()
        states = [HEALTH_NAMES[health] for health in table.health[:3]]
        assert not {"stale", "degraded", "lost", "diverged"} & {*states[1:]}, (at, states)
        if at > 4.0 and not 10.0 <= at < 19.0 and not 30.0 <= at < 34.0 and not 45.0 <= at < 49.0:
            assert states[0] not in ("stale", "degraded", "lost", "diverged"), (at, states)
            np.testing.assert_allclose(table.mean[0, 0], table.mean[1, 0], atol=0.5)
    fleet.stop()


@pytest.mark.parametrize("group", ["", "$share/fleets/"])
def test_the_asset_is_a_level_of_the_topic(tmp_path, broker, listener, group):
    topics = {
        f"{group}plant/{{asset}}/temperature": "winding",
        "line/{asset}": {"values": {"winding": "v"}, "time": "t"},
    }
    fleet, said = running(tmp_path, {"type": "mqtt", "host": "127.0.0.1", "port": broker.port, "topics": topics})
    assert fleet.source.connected.wait(LIMIT_S)
    listener.publish("plant/pump 3/temperature", "41.5")
    listener.publish("line/pump 4", {"v": 42.5, "t": time.time_ns()})
    listener.publish("plant//temperature", "41.5")
    wait_for(lambda: fleet.step() and said and len(fleet.table()[1]) == 2)
    _, names, table = fleet.table()
    assert names == ["pump 3", "pump 4"] and table.events.tolist() == [1, 1]
    assert said[0].startswith("plant//temperature: asset is ''; it must be a text")
    fleet.stop()


@cases(__file__, "fleet_topics.csv")
def test_topics_that_do_not_name_an_asset_are_one_line(topics, text, tmp_path):
    source = {"type": "mqtt", "host": "127.0.0.1", "port": 1, "topics": json.loads(topics)}
    said = error_of(NisusError, running, tmp_path, source)
    assert text in said and "pumps.yaml:1" in said


def test_a_password_that_is_not_set_is_one_line_with_its_place(tmp_path, monkeypatch):
    monkeypatch.delenv("NISUS_NO_SECRET", raising=False)
    more = {"user": "a", "password_env": "NISUS_NO_SECRET"}
    source = {"type": "mqtt", "host": "a", "topics": {"{asset}/t": "winding"}, **more}
    rule = "is NISUS_NO_SECRET, an environment variable that is not set; set it before the start"
    text = f"{tmp_path / 'pumps.yaml'}:1: source.password_env {rule}"
    assert error_of(NisusError, running, tmp_path, source) == text
    with pytest.raises(NisusError, match="NISUS_NO_SECRET"):  # before anything is compiled
        load_fleet(tmp_path / "pumps.yaml").check_files()


KILLED = """
import os, signal
from pathlib import Path
import app.extensions.fleet.running as live
import sources.tables.follow as follow
from app.extensions.fleet.plan import load_fleet
follow.PIECE_BYTES, live.FIRST_ROOM, live.BLOCK = 2**14, 4, 16
live.STORE_PERIOD_S, live.STORE_SHARE, live.MAX_PENDING = 0.0, 1e9, 1
fleet = live.RunningFleet(load_fleet("pumps.yaml"), print, threads=1, store=Path("fleet.store"))
def events():
    return int(fleet.table()[2].events.sum())
while events() < 2500:
    fleet.step()
fleet._keep = lambda at_once=False: None
kept = events()
while events() == kept:  # read and folded, but not written
    fleet.step()
print(events(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_fleet_that_was_killed_continues_to_the_same_bits(ending, tmp_path, monkeypatch):
    """In the middle of the second file, with assets that come after the restart and some that are silent."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(live, "FIRST_ROOM", 4)
    monkeypatch.setattr(live, "BLOCK", 16)
    rng = np.random.default_rng(1)
    rows = [
        (float(t), f"pump {k}", round(40.0 + float(rng.normal()), 3))
        for t in range(300)
        for k in range(40)
        if t >= 4 * k and not (k == 3 and t > 100)
    ]
    for name, part in (("a", rows[:3000]), ("b", rows[3000:])):
        write(tmp_path / f"{name}.{ending}", part)
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files=f"'?.{ending}'"))
    whole = RunningFleet(load_fleet("pumps.yaml"), lambda *_: None, threads=1)
    monkeypatch.setattr(live, "MAX_PENDING", 1)
    monkeypatch.setattr("sources.tables.follow.PIECE_BYTES", 2**14)
    whole.run()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    killed = run_python(KILLED, status=-signal.SIGKILL, cwd=tmp_path, env=environment, timeout=LIMIT_S)
    events = int(killed.stdout.split()[-1])
    again = RunningFleet(load_fleet("pumps.yaml"), lambda *_: None, threads=1, store=tmp_path / "fleet.store")
    before = int(again.table()[2].events.sum())
    assert 0 < before < events < len(rows)
    again.run()
    assert again.table()[1] == whole.table()[1]
    for mine, its in zip(again.table()[2][1:], whole.table()[2][1:], strict=True):
        assert mine.tobytes() == its.tobytes()
    again.stop()
    whole.stop()
    with pytest.raises(NisusError, match=r"fleet.store: was written with another model, tuning or assets; remove it"):
        plan = load_fleet("pumps.yaml", {"R.winding": "9"})
        RunningFleet(plan, lambda *_: None, threads=1, store=tmp_path / "fleet.store")


def test_a_store_on_a_full_disk_is_tried_again_while_the_fleet_goes_on(tmp_path, monkeypatch):
    full, archived = [False], []
    write_blocks = live.Store.write_blocks

    def write_or_fail(store, blocks):
        if full[0]:
            raise SourceError("the disk is full")
        write_blocks(store, blocks)

    monkeypatch.setattr(live.Store, "write_blocks", write_or_fail)
    monkeypatch.setattr(live, "STORE_PERIOD_S", 0.0)
    monkeypatch.setattr(live, "STORE_SHARE", 1e9)
    monkeypatch.setattr(live, "RETRY_PERIOD_S", 0.0)
    first, said = running(tmp_path)
    path = tmp_path / "fleet.store"
    fleet = RunningFleet(first.plan, lambda key, text: said.append(text), threads=1, store=path)
    fleet.archive = SimpleNamespace(append=lambda at, events: archived.append(len(events)), stop=lambda: None)
    fleet.archive.written = lambda rows: nullcontext([fleet.archive.append(*row) for row in rows])
    source = messages_of(fleet)
    for k in range(6):
        full[0] = 1 < k < 5
        first.source.send([message(k, "a", 40.0 + k)])
        source.send([message(k, "a", 40.0 + k)])
        assert first.step() and fleet.step()
        assert fleet.has(source.accepted) is (None if full[0] else True)
    assert said == [
        "the disk is full; the fleet goes on without it, and tries again",
        f"store {path}: it is written again",
    ]
    assert archived == [1] * 6 and fleet.failure == ""
    assert same(fleet.table()[2], first.table()[2])
    fleet.stop()
    again = RunningFleet(first.plan, lambda *_: None, threads=1, store=path)
    assert same(again.table()[2], first.table()[2])
    again.stop()
    first.stop()


def test_a_fleet_that_stands_still_refuses_messages_and_is_not_ready(tmp_path, monkeypatch):
    """Also those that it had accepted, but neither folded nor stored."""
    fleet, said = running(tmp_path)
    fleet.file = SimpleNamespace(path="fleet.store", write_blocks=lambda blocks: None, close=lambda: None)
    api = FleetApi(fleet)
    assert api.unready() == "no measurement has arrived"

    def send(k):
        found = asyncio.run(send_to(fleet, [message(k, "a", 40.0)]))
        return found["items"][0]["status"], found["items"][0].get("reason", ""), found["stored"]

    fleet.start()
    assert send(0) == ("accepted", "", True)
    assert api.unready() == ""
    monkeypatch.setattr(fleet.fleet, "advance", lambda: 1 / 0)
    assert send(1) == ("refused", refused := "nothing is folded any more; send it again after a restart", False)
    assert send(2) == ("refused", refused, False)
    assert api.unready() == "ZeroDivisionError: division by zero" and api.unready() in said[-1]
    fleet.stop()


def same(mine, its):
    """Whether two tables have the same assets and the same bits."""
    pairs = zip(mine[1:], its[1:], strict=True)
    return mine.assets == its.assets and all(a.astype(b.dtype).tobytes() == b.tobytes() for a, b in pairs)


def test_silent_assets_of_a_table_are_dated_by_their_silence_and_late_rows_dropped(tmp_path, monkeypatch):
    """By the newest time of all, whenever that was looked at."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(live, "MAX_PENDING", 500)
    monkeypatch.setattr("sources.tables.follow.PIECE_BYTES", 2**13)
    rng = np.random.default_rng(2)
    rows = [
        (float(t if (t, k) != (90, 5) else 3.5), f"pump {k}", round(40.0 + float(rng.normal()), 3))
        for t in range(100)
        for k in range(30)
        if not (k % 7 == 3 and t > 40)
    ]
    write(tmp_path / "a.csv", rows)
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files="a.csv"))
    fleet = RunningFleet(load_fleet("pumps.yaml"), lambda *_: None, threads=1)
    fleet.run()
    _, names, table = fleet.table()
    assert len(names) == 30 and table.stale.sum() == 1 and "stale" in {HEALTH_NAMES[k] for k in table.health}
    assert set(table.since[table.health == STALE]) == {40.0 + fleet.plan.twin.policy.stale_after}
    fleet.stop()


def mqtt(port, **more):
    topics = {"plant/{asset}": {"values": {"winding": "v"}, "time": "t"}}
    return {"type": "mqtt", "host": "127.0.0.1", "port": port, "topics": topics, "client_id": "pumps", **more}


def packet(mid, k, asset="a", dup=False):
    payload = json.dumps({"v": 40.0 + k, "t": BEGIN + k * SECOND}).encode()
    return SimpleNamespace(mid=mid, topic=f"plant/{asset}", payload=payload, dup=dup, qos=1, retain=False)


def test_packets_that_are_sent_again_count_once(tmp_path, monkeypatch):
    """Before and after they are stored, after a restart, and with an id that the broker has used again."""
    monkeypatch.setattr(live, "STORE_PERIOD_S", 1e9)

    topic = TopicMap(values={"winding": "v"}, time="t", asset=1)

    def opened():
        fleet, _ = running(tmp_path, mqtt(1))
        fleet.stop()
        fleet = RunningFleet(fleet.plan, lambda *_: None, threads=1, store=tmp_path / "fleet.store")
        fleet._due = 1e18  # it is written when the test says so
        acknowledged, arrived = [], fleet.source._callback(topic)
        monkeypatch.setattr(fleet.source._client, "ack", lambda mid, qos: acknowledged.append(mid))
        return fleet, acknowledged, lambda *packets: [arrived(fleet.source._client, None, each) for each in packets]

    fleet, acknowledged, arrive = opened()
    arrive(packet(1, 0), packet(2, 1))
    fleet.step()
    fleet._keep(at_once=True)
    assert acknowledged == [1, 2]
    arrive(packet(3, 2), packet(3, 2, dup=True))
    fleet.step()
    arrive(packet(3, 2, dup=True), packet(2, 1, dup=True))
    fleet.step()
    assert acknowledged == [1, 2, 2] and fleet.table()[2].events.tolist() == [3]
    fleet.stop()  # without the store: packet 3 is lost with the process, and sent again
    fleet, acknowledged, arrive = opened()
    assert fleet.table()[2].events.tolist() == [2]
    arrive(packet(2, 1, dup=True), packet(3, 2, dup=True), packet(1, 3, dup=True))
    fleet.step()
    assert acknowledged == [2] and fleet.table()[2].events.tolist() == [4]
    fleet._keep(at_once=True)
    assert acknowledged == [2, 3, 1]
    last = folded([40.0, 41.0, 42.0, 43.0])
    assert fleet.table()[2].mean[0].tobytes() == last.mean.tobytes()
    fleet.stop()


def test_a_broker_keeps_what_was_not_stored(tmp_path, broker, listener, monkeypatch):
    monkeypatch.setattr(live, "STORE_PERIOD_S", 1e9)
    named = ["pump 3", "pump 4", "pump 5"]
    before, said = running(tmp_path, mqtt(broker.port), assets=named)
    before.stop()
    plan, store = before.plan, tmp_path / "fleet.store"
    fleet = RunningFleet(plan, lambda key, text: said.append(text), threads=1, store=store)
    assert fleet.names == named and fleet.source.connected.wait(LIMIT_S)

    def publish(first, last):
        for k in range(first, last):
            for name in [*named, "pump 6"]:  # another process has the last one
                listener.publish(f"plant/{name}", {"v": 40.0 + k, "t": BEGIN + k * SECOND})

    def step_until(fleet, count):
        wait_for(lambda: fleet.step() and fleet.table()[2].events.min(initial=10**9) >= count)

    publish(0, 30)
    step_until(fleet, 30)
    fleet._keep(at_once=True)
    publish(30, 60)
    step_until(fleet, 60)
    fleet.stop()  # as with a kill: nothing was stored or acknowledged since
    publish(60, 70)
    again = RunningFleet(plan, lambda *_: None, threads=1, store=store)
    assert again.table()[2].events.tolist() == [30] * 3
    step_until(again, 70)
    assert again.table()[2].events.tolist() == [70] * 3 and not said
    last = folded([40.0 + k for k in range(70)])
    assert again.table()[2].mean.tobytes() == np.tile(last.mean, (3, 1)).tobytes()
    again.stop()
    with pytest.raises(NisusError, match=r"source.qos is 2; set it to 1"):
        path = tmp_path / "pumps.yaml"
        path.write_text(json.dumps({"twin": "motor_winding", "source": mqtt(broker.port, qos=2)}))
        RunningFleet(load_fleet(path), lambda *_: None, threads=1, store=tmp_path / "new.store")


def test_killed_processes_leave_the_table_of_one_that_was_not(tmp_path):
    program("mosquitto")
    survive_fleet(2, tmp_path, FleetRun(assets=8, rounds=60, seconds=2.0))
