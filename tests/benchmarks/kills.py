"""`python -m tests.benchmarks.kills --kills 200`: is a twin that is killed while it writes its store the same again?

A process runs a twin with a store and is fed at 1 kHz through a pipe; some measurements are late. It is killed at
random moments (SIGKILL), and another one continues. After each kill the store is read: it must be complete, and have
every measurement that was sent a second before the kill. At the end the events of all processes are folded in one go:
each stored state of the filter must be that of the undisturbed fold, bit for bit. It exits with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import os
import select
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from app.live.store import Store, read_store
from app.twin.twin import Twin, load_twin
from app.web.running import OpenedTwin, RunningTwin
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.snapshots import Base
from tests.conftest import ROOT

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
        t = records["t"].astype(np.int64)
        arrival = np.full(n, time.time_ns())
        return Events(t, arrival, np.full(n, READING, np.int8), np.zeros(n, np.int32), values)

    def now(self) -> None:
        """See `Source`."""

    def close(self) -> None:
        """See `Source`."""


def run_fed(path: Path) -> None:
    """Run the twin until this process is killed."""
    twin = fed_twin()
    running = RunningTwin(OpenedTwin(twin, lambda report: PipeSource(twin.model.width), store=path), door=None)
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
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, policy=twin.policy, expected=twin.expected)
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


def main() -> int:
    """Run the benchmark, or one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fed", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.fed is not None:
        run_fed(given.fed)
    with tempfile.TemporaryDirectory() as folder:
        try:
            print(survive(given.kills, Path(folder), given.seed, report=lambda line: print(line, flush=True)))
        except AssertionError as error:
            print(f"wrong: {error}")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
