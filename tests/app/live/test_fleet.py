"""Fleets of messages, by HTTP and MQTT: each asset has the values of a fold over its own messages."""

import io
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow as pa
import pytest

import app.live.fleet as live
from app.live.fleet import RunningFleet
from app.twin.fleet import load_fleet
from app.twin.twin import load_twin
from app.web.readings import READERS, answer, messages_of
from estimators import Log
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.log import Events
from estimators.track import HEALTH_NAMES, USABLE
from tests.app.cli.test_fleet import FLEET, write
from tests.app.outputs.broker import Broker, Listener, needs_mosquitto
from tests.conftest import ROOT

BEGIN, SECOND = 1_767_225_600 * 10**9, 10**9


def running(folder, source, **more):
    path = folder / "pumps.yaml"
    path.write_text(json.dumps({"twin": "motor_winding", "source": source, **more}))
    said: list[str] = []
    found = RunningFleet(load_fleet(path), lambda key, text: said.append(text), threads=1)
    return found, said


def message(k, asset, value):
    return {"time": BEGIN + k * SECOND, "asset": asset, "values": {"winding": value}}


def folded(values):
    """The last row of a fold over measurements of one asset, one a second."""
    twin = load_twin("motor_winding")
    t = BEGIN + np.arange(len(values)) * SECOND
    log = Log.of(twin.model)
    log.extend(Events(t, t, np.zeros(t.size, np.int8), np.zeros(t.size, np.int32), np.array(values)[:, None]))
    fold = Fold("kf", twin.model, twin.tuning, log, policy=twin.policy, expected=np.ones(1, np.bool_))
    fold.advance()
    return fold.track.select(fold.n - 1)


@pytest.mark.parametrize("kind", sorted(READERS))
def test_messages_have_the_asset_as_a_field_in_any_form(kind, tmp_path):
    fleet, _ = running(tmp_path, {"type": "push"})
    source = messages_of(fleet)
    sent = [message(k, asset, 40.0 + k + j) for k in range(6) for j, asset in enumerate(("a", "b/c"))]
    if "arrow" in kind:
        rows = [{"time": item["time"], "asset": item["asset"], **item["values"]} for item in sent]
        batch = pa.RecordBatch.from_pylist(rows)
        sink = io.BytesIO()
        with pa.ipc.new_stream(sink, batch.schema) as stream:
            stream.write_batch(batch)
        body = sink.getvalue()
    elif "ndjson" in kind:
        body = "\n".join(map(json.dumps, sent)).encode()
    else:
        body = json.dumps(sent).encode()
    assert answer(source, READERS[kind](body, source.fields))["accepted"] == 12
    assert fleet.step()
    _, names, table = fleet.table()
    assert names == ["a", "b/c"]
    for j in range(2):
        last = folded([40.0 + k + j for k in range(6)])
        assert table.mean[j].tobytes() == last.mean.tobytes() and table.health[j] == last.health
    fleet.stop()


def test_messages_without_the_name_of_an_asset_are_refused(tmp_path):
    fleet, said = running(tmp_path, {"type": "push"}, assets=["a"])
    source = messages_of(fleet)
    wrong = [{"values": {"winding": 1.0}}, message(0, "", 1.0), message(0, 7, 1.0), message(0, "x" * 201, 1.0)]
    found = answer(source, [*wrong, message(0, "a", 41.0), message(0, "stranger", 41.0)])
    assert found["refused"] == 4 and "asset is" in found["items"][0]["reason"]
    fleet.step()
    assert fleet.table()[1] == ["a"] and fleet.table()[2].events.tolist() == [1]
    assert said == ["pumps.yaml: asset 'stranger' is not among assets; add it to assets"]
    fleet.stop()


def test_an_asset_that_is_silent_becomes_stale_by_the_clock_of_the_others(tmp_path):
    fleet, _ = running(tmp_path, {"type": "push"})
    source = messages_of(fleet)
    source.send([message(k, asset, 40.0) for k in range(5) for asset in ("a", "b")])
    fleet.step()
    for k in range(6, 60, 3):
        source.send([message(k, "b", 40.0)])
        fleet.step()
    _, _, table = fleet.table()
    assert HEALTH_NAMES[table.health[0]] == "stale" and table.health[1] in USABLE and table.age[1] == 0.0
    assert table.age[0] > fleet.plan.twin.policy.stale_after
    fleet.stop()


def test_the_asset_is_a_level_of_the_topic(tmp_path):
    needs_mosquitto()
    broker = Broker(tmp_path)
    topics = {"plant/{asset}/temperature": "winding", "line/{asset}": {"values": {"winding": "v"}, "time": "t"}}
    fleet, said = running(tmp_path, {"type": "mqtt", "host": "127.0.0.1", "port": broker.port, "topics": topics})
    assert fleet.source.connected.wait(60.0)
    listener = Listener(broker)
    listener.publish("plant/pump 3/temperature", "41.5")
    listener.publish("line/pump 4", {"v": 42.5, "t": time.time_ns()})
    listener.publish("plant//temperature", "41.5")
    while not said or len(fleet.table()[1]) < 2:
        fleet.step()
    _, names, table = fleet.table()
    assert names == ["pump 3", "pump 4"] and table.events.tolist() == [1, 1]
    assert said[0].startswith("plant//temperature: asset is ''; it must be a text")
    listener.stop()
    fleet.stop()
    broker.stop()


@pytest.mark.parametrize(
    ("topics", "text"),
    [
        ({"plant/+/t": "winding"}, "one of its levels must be {asset}"),
        ({"{asset}/{asset}": "winding"}, "one of its levels must be {asset}"),
        ({"a/{asset}/+": "winding", "a/+/{asset}": "winding"}, "has a/+/+ twice"),
        ({"a/{asset}/x#": "winding"}, "+ and # must stand alone"),
    ],
)
def test_topics_that_do_not_name_an_asset_are_one_line(topics, text, tmp_path):
    with pytest.raises(NisusError) as caught:
        running(tmp_path, {"type": "mqtt", "host": "127.0.0.1", "port": 1, "topics": topics})
    assert text in str(caught.value) and "\n" not in str(caught.value) and "pumps.yaml:1" in str(caught.value)


KILLED = """
import os, signal
from pathlib import Path
import app.live.fleet as live
import sources.tables.follow as follow
from app.twin.fleet import load_fleet
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
    killed = subprocess.run(
        [sys.executable, "-c", KILLED],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, text=True, capture_output=True, timeout=120,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL, killed.stderr
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
