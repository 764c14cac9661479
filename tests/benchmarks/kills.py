"""`python -m tests.benchmarks.kills --kills 200`: is a twin that is killed while it writes its store the same again?

A process runs a twin with a store and is fed at 1 kHz through a pipe; some measurements are late. It is killed at
random moments (SIGKILL), and another one continues. After each kill the store is read: it must be complete, and have
every measurement that was sent a second before the kill. At the end the events of all processes are folded in one go:
each stored state of the filter must be that of the undisturbed fold, bit for bit. It exits with 1 if anything is wrong.

With `--fleet` the process of a fleet is killed while messages are published to a broker, some of them twice: at the end
the table of all assets must be that of a process without kills.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow.parquet

from app.engine.store import Store, read_store
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from app.extensions.fleet.table import arrow_table, in_name_order
from app.extensions.mqtt.source import MqttSource, TopicMap, mqtt_client
from app.terminal import EndRequest, when_asked_to_end
from app.twin.twin import Twin, load_twin
from app.web.readings import messages_of
from app.web.running import OpenedTwin, RunningTwin
from estimators.log import READING, Events, Log
from estimators.snapshots import Base
from sources.messages import ACCEPTED
from tests import ROOT
from tests.extensions.mqtt.broker import Broker

PERIOD_S = 0.001
LATE_EVERY, LATE_S = 50, 0.02
"""Each of so many measurements is sent that late."""

MIN_RUN_S, MAX_RUN_S = 0.2, 2.5
"""Seconds for which a process is fed before it is killed."""

HISTORY_EVENTS = 4096
"""More than one process is fed, so that no event is dropped from the history before the store of its process is read.
Older ones are dropped beyond 7168."""

MAX_LOSS_S = 1.0
RECORD = struct.Struct("<qd")


def fed_twin() -> Twin:
    """Return the twin, with so short a history that its oldest events are dropped every few seconds."""
    return load_twin("motor_winding", overrides={"history": str(HISTORY_EVENTS)})


class PipeSource:
    """A live source of times (ns) and values from standard input."""

    live = True

    def __init__(self, width: int) -> None:
        self._width, self._rest = width, b""

    def read(self, timeout: float) -> Events | None:
        """See `Source`."""
        if not select.select([0], [], [], timeout)[0]:
            return Events.empty(self._width)
        data = self._rest + os.read(0, 1 << 16)
        whole = len(data) // RECORD.size * RECORD.size
        self._rest = data[whole:]
        records = np.frombuffer(data[:whole], [("t", "<i8"), ("value", "<f8")])
        n = records.size
        values = np.full((n, self._width), np.nan)
        values[:, 0] = records["value"]
        events = Events.alike(READING, records["t"].astype(np.int64), values)
        return events._replace(arrival=np.full(n, time.time_ns()))

    def now(self) -> None:
        """See `Source`."""

    def close(self) -> None:
        """See `Source`."""


def run_fed(path: Path) -> None:
    """Run the twin until this process is killed."""
    twin = fed_twin()
    running = RunningTwin(OpenedTwin(twin, lambda report: PipeSource(twin.model.width), store=path), http_server=None)
    running.start()
    print("ready", flush=True)
    threading.Event().wait()


class Killed(NamedTuple):
    """Store of a killed process, and the seconds of measurements that were lost."""

    base: Base | None
    first: int
    events: Events
    lost: float


def feed_and_kill(path: Path, rng: np.random.Generator) -> Killed:
    """Start a process, feed it, kill it, and read its store.

    Raises:
        AssertionError: If the store is not complete.
    """
    command = [sys.executable, "-m", "tests.benchmarks.kills", "--fed", str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        sent: list[tuple[float, int]] = []
        begun, length = time.monotonic(), rng.uniform(MIN_RUN_S, MAX_RUN_S)
        value = 40.0
        while (now := time.monotonic()) < begun + length:
            due = int((now - begun) / PERIOD_S) - len(sent)
            data = b""
            for k in range(len(sent), len(sent) + due):
                late = LATE_S if k % LATE_EVERY == LATE_EVERY - 1 else 0.0
                t = time.time_ns() - round(late * 1e9)
                value += rng.normal() * 0.01
                data += RECORD.pack(t, value)
                sent.append((now, t))
            process.stdin.write(data)
            process.stdin.flush()
            time.sleep(PERIOD_S)
        killed = time.monotonic()
        process.kill()
        process.wait()
    store = Store(path)
    stored = read_store(store, fed_twin())
    store.close()
    assert stored is not None
    known = set(stored.tail.events.t.tolist())
    lost = max((killed - at for at, t in sent if t not in known), default=0.0)
    return Killed(stored.tail.base, stored.tail.first, stored.tail.events, lost)


def check_states(kills: list[Killed]) -> int:
    """Fold the events of all processes in one go and compare its states with the stored ones; return how many.

    Raises:
        AssertionError: If one differs.
    """
    twin = fed_twin()
    events = kills[0].events
    for item in kills[1:]:
        assert item.first <= len(events), f"{item.first - len(events)} events were dropped before they were read"
        events = Events.concat([events.select(slice(0, item.first)), item.events], twin.model.width)
    log = Log.resume(twin.model, None, events)
    fold = twin.fold(log, policy=twin.policy, expected=twin.expected)
    bases = {item.base.first: item.base for item in kills if item.base is not None}
    for first in sorted(bases):
        fold.advance(first - fold.n)
        for name, mine, its in zip(Base._fields, fold.base_here(), bases[first], strict=True):
            same = np.asarray(mine).tobytes() == np.asarray(its).tobytes()
            assert same, f"{name} of the state before event {first} differs from that of the undisturbed fold"
    return len(bases)


def survive(
    kills: int, folder: Path, seed: int = 1, *, limit: float = MAX_LOSS_S, report: Any = lambda line: None
) -> str:
    """Kill the process so many times; return the largest loss and the number of states that were compared in a line.

    Raises:
        AssertionError: If a store is not complete, `limit` seconds or more are lost, or a state differs.
    """
    rng, done = np.random.default_rng(seed), []
    for k in range(kills):
        done.append(feed_and_kill(folder / "fed.store", rng))
        report(f"kill {k + 1}: {done[-1].first + len(done[-1].events)} events, {done[-1].lost:.2f} s lost")
    compared = check_states(done)
    losses = np.sort([item.lost for item in done])
    line = f"{compared} states are those of the undisturbed fold; lost: median {np.median(losses):.2f} s"
    line += f", 99 % {np.percentile(losses, 99):.2f} s, most {losses[-1]:.2f} s"
    assert losses[-1] < limit, f"{line}; a kill may lose {limit:g} s"
    return line


class FleetRun(NamedTuple):
    """A fleet of MQTT messages that are published while its process is killed."""

    assets: int = 40
    rounds: int = 600
    """Measurements of each asset, one a round."""
    seconds: float = 600.0

    def messages(self, k: int) -> list[tuple[str, str]]:
        """Return topics and payloads of a round; each 20th is published twice."""
        rng = np.random.default_rng([1, k])
        found = []
        for j in range(self.assets):
            body = {"v": round(40.0 + float(rng.normal()), 3), "t": FLEET_BEGIN + k * 10**9 + j, "n": k}
            found += [(f"plant/pump {j}", json.dumps(body))] * (2 if (k * self.assets + j) % 20 == 0 else 1)
        return found


FLEET_BEGIN = 1_767_225_600 * 10**9
LONG_S = "1e6"
"""Longer than the run: no asset is silent, so the table does not depend on the clock."""

SUBSCRIBED = "subscribed"
"""Line that the process of a fleet prints once the broker keeps its messages."""

FLEET_TOPIC: dict[str, Any] = {"values": {"winding": "v"}, "time": "t", "sequence": "n"}


def run_fleet_part(folder: Path, expected: int) -> None:
    """Run a fleet until its process is killed; write the table once it has all events."""
    overrides = {"time.degraded_after": LONG_S, "time.stale_after": LONG_S}
    plan = load_fleet(folder / "pumps.yaml", overrides)
    fleet = RunningFleet(plan, lambda *_: None, threads=1, store=folder / "fleet.store")
    fleet.start()
    cast(MqttSource, fleet.source).connected.wait()
    print(SUBSCRIBED, flush=True)
    done = EndRequest()
    when_asked_to_end(done.set)
    while not done.wait(0.1):
        table = in_name_order(fleet.table()[2])
        if int(table.events.sum()) >= expected:
            pyarrow.parquet.write_table(arrow_table(plan.twin.model, table), folder / "table.part")
            (folder / "table.part").rename(folder / "table.parquet")
    fleet.stop()


def undisturbed(folder: Path, run: FleetRun) -> bytes:
    """Return the table of a process that gets each message once, as bytes of Parquet."""
    path = folder / "one.yaml"
    path.write_text(json.dumps({"twin": "motor_winding", "source": {"type": "push"}}))
    overrides = {"time.degraded_after": LONG_S, "time.stale_after": LONG_S}
    fleet = RunningFleet(load_fleet(path, overrides), lambda *_: None, threads=1)
    topic = TopicMap(**FLEET_TOPIC, asset=1)
    for k in range(run.rounds):
        sent = [topic.message(name, text.encode()) for name, text in dict.fromkeys(run.messages(k))]
        assert {item.status for item in messages_of(fleet).send(sent)} == {ACCEPTED}
        fleet.step()
    table = arrow_table(fleet.plan.twin.model, in_name_order(fleet.table()[2]))
    fleet.stop()
    pyarrow.parquet.write_table(table, folder / "one.parquet")
    return (folder / "one.parquet").read_bytes()


class FleetProcess:
    """The process of a fleet."""

    def __init__(self, folder: Path, expected: int) -> None:
        command = [sys.executable, "-m", "tests.benchmarks.kills", "--fed", str(folder), "--fleet"]
        command += ["--kills", str(expected)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        self.subscribed = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.strip() == SUBSCRIBED:
                self.subscribed.set()

    def kill(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait()


def survive_fleet(
    kills: int, folder: Path, run: FleetRun, seed: int = 1, report: Callable[[str], None] = lambda line: None
) -> str:
    """Publish the messages of a fleet while its process is killed; return a line of results.

    Raises:
        AssertionError: If the table is not that of the undisturbed process, to the last bit.
    """
    wanted, expected = undisturbed(folder, run), run.assets * run.rounds
    broker = Broker(folder, "max_queued_messages 0\nmax_inflight_messages 0\n")
    source = {"type": "mqtt", "host": "127.0.0.1", "port": broker.port, "client_id": "kills",
              "topics": {"plant/{asset}": FLEET_TOPIC}}  # fmt: skip
    fleet = {"twin": "motor_winding", "source": source}
    (folder / "pumps.yaml").write_text(json.dumps(fleet))
    process, rng = FleetProcess(folder, expected), np.random.default_rng(seed)
    publisher = mqtt_client(SimpleNamespace(user=None, ca_file=None), None, client_id="")  # type: ignore[arg-type]
    publisher.max_queued_messages_set(0)
    publisher.connect("127.0.0.1", broker.port)
    publisher.loop_start()
    process.subscribed.wait()  # from now on, also while it is dead
    killed, published, begun = 0, 0, time.monotonic()
    due = np.sort(rng.uniform(0.0, run.seconds, kills))
    while published < run.rounds or killed < kills:
        now = time.monotonic() - begun
        while published < min(run.rounds, now / run.seconds * run.rounds):
            for name, text in run.messages(published):
                publisher.publish(name, text, qos=1)
            published += 1
        if killed < kills and now > due[killed] and process.subscribed.is_set():
            process.kill()
            process, killed = FleetProcess(folder, expected), killed + 1
            report(f"kill {killed} at {now:.1f} s, after {published} rounds")
        time.sleep(0.01)
    while not (folder / "table.parquet").exists():
        time.sleep(0.05)
    found = (folder / "table.parquet").read_bytes()
    process.process.terminate()
    process.process.wait()
    publisher.disconnect()
    publisher.loop_stop()
    broker.stop()
    line = f"{expected} messages of {run.assets} assets, {killed} kills: the table is"
    assert found == wanted, f"{line} another than that of a process without kills"
    return f"{line} that of a process without kills, bit for bit"


def main() -> int:
    """Run the benchmark, or one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fed", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--fleet", action="store_true", help="kill the process of a fleet")
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the stream of a fleet")
    given = parser.parse_args()
    if given.fed is not None and given.fleet:
        run_fleet_part(given.fed, given.kills)
        return 0
    if given.fed is not None:
        run_fed(given.fed)
    with tempfile.TemporaryDirectory() as folder:
        try:
            if given.fleet:
                run = FleetRun(seconds=given.seconds)
                print(survive_fleet(given.kills, Path(folder), run, given.seed, lambda line: print(line, flush=True)))
                return 0
            print(survive(given.kills, Path(folder), given.seed, report=lambda line: print(line, flush=True)))
        except AssertionError as error:
            print(f"wrong: {error}")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
