"""`python -m tests.benchmarks.soak`: an hour at 1 kHz of the worst mix of faults, as fast as possible.

The engine runs without a page on a simulated asset; every few seconds of the asset's time some faults of all kinds
begin, which last for some seconds. At the end every event must be accounted for, memory must have stayed flat once the
history was full, and what watches the twin must still be there. It exits with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import resource
import sys
import threading
import time
from pathlib import Path

import numpy as np

from app.live.engine import Engine
from app.live.episode_log import MAX_EPISODES_PERIOD_S
from app.studies.stress.scenario import asset_of
from app.twin.twin import Twin, load_twin
from estimators.log import MARK, Events
from estimators.track import HEALTH_NAMES, SUSPECT, TRACKING, VERDICT_NAMES
from sources.faults.kinds import Fault
from sources.faults.layer import Faults
from sources.source import WRONG_TIME

TWIN = "motor_can"
STEP = 0.003  # Seconds between the asset's steps, each of three readings: a thousand a second
AT_ONCE = 512  # Events of the asset that are passed on together
TRANSIT = 1_000_000  # ns from the measurement to its arrival
EVERY = 8.0  # Seconds of the asset between two mixes

CALM = 120.0
"""Seconds of the asset at the end without a fault, in which the twin must come to itself."""

FLAT = 2.0
"""MB that a million events may add, by the line fitted: a leak of two bytes an event."""

LEAST = 60  # Samples of memory for a line, two a second

MIXES: tuple[tuple[dict[str, object], ...], ...] = (
    ({"kind": "delay", "sensor": "winding", "size": 0.5},
     {"kind": "spike", "sensor": "yoke", "size": 20.0, "rate": 0.05}),
    ({"kind": "jitter", "size": 0.02}, {"kind": "duplicate", "sensor": "tooth", "rate": 0.5, "count": 3}),
    ({"kind": "jitter", "sensor": "yoke", "size": 1.0}, {"kind": "dropout", "sensor": "winding", "rate": 0.3}),
    ({"kind": "reorder", "rate": 0.5}, {"kind": "stuck", "sensor": "winding"}),
    ({"kind": "clock_jump", "sensor": "tooth", "size": 3600.0}, {"kind": "noise", "sensor": "yoke", "size": 3.0}),
    ({"kind": "clock_jump", "size": -30.0},),
    ({"kind": "clock_drift", "sensor": "yoke", "size": 0.05}, {"kind": "bias", "sensor": "tooth", "size": 5.0}),
    ({"kind": "bursts", "sensor": "winding", "every": 3.0}, {"kind": "scale", "sensor": "yoke", "size": 1.1}),
    ({"kind": "swap", "sensor": "winding", "other": "yoke"}, {"kind": "quantisation", "sensor": "tooth", "size": 2.0}),
    ({"kind": "silence", "sensor": "tooth"}, {"kind": "drift", "sensor": "winding", "size": 0.5}),
    ({"kind": "duplicate", "rate": 0.2, "every": 0.5, "count": 2}, {"kind": "delay", "sensor": "tooth", "size": 3.0}),
    ({"kind": "silence"},),
)  # fmt: skip


def resident() -> float:
    """Return resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


class Soaked:
    """An asset behind faults that come and go; counts what it makes and gives, and ends after `duration` seconds."""

    live = False

    def __init__(self, twin: Twin, duration: float, seed: int) -> None:
        asset = asset_of(twin, seed)
        assert asset is not None
        self._asset, self._width = asset, twin.model.width
        self.faults = Faults(twin.model, seed=seed)
        self._rng = np.random.default_rng(seed)
        self._next, self._duration = EVERY, duration
        self.seconds = 0.0
        self.made, self.sent, self.marks, self.mixes = 0, 0, 0, 0

    def read(self, timeout: float) -> Events | None:
        """The next events."""
        if self._next <= self.seconds < self._duration - CALM:
            for given in MIXES[int(self._rng.integers(len(MIXES)))]:
                length = float(self._rng.uniform(0.5, 1.5)) * EVERY
                self.faults.inject(Fault(end=length, **given))  # type: ignore[arg-type]
            self.mixes += 1
            self._next += EVERY
        if self.seconds < self._duration:
            batch = self.faults.pass_on(self._make())
        else:
            batch = self.faults.finish()
            if not len(batch):
                return None
        self.sent += len(batch)
        self.marks += int(np.sum(batch.kind == MARK))
        return batch

    def _make(self) -> Events:
        parts: list[Events] = []
        while sum(map(len, parts)) < AT_ONCE:
            parts.append(self._asset.read(0.0))  # type: ignore[arg-type]
        batch = Events.concat(parts, self._width)
        self.made += len(batch)
        self.seconds = float(batch.t.max()) * 1e-9
        # As from a bus: when it arrived is known.
        return batch._replace(arrival=batch.arrival + TRANSIT)

    def now(self) -> int | None:
        """It tells none, so that the engine does not ask for the estimate by itself."""
        return None

    def close(self) -> None:
        """Let go."""
        self._asset.close()


class Soak:
    """The run, and what is to be said of it; `wrong` gathers what falls short."""

    def __init__(self, seconds: float, seed: int) -> None:
        twin = load_twin(TWIN, overrides={"source.asset.step": str(STEP)})
        self.source = Soaked(twin, seconds, seed)
        self.engine = Engine(twin, lambda report: self.source)
        self.samples: list[tuple[float, float]] = []
        self.wrong: list[str] = []

    def run(self) -> None:
        """Until the source has ended."""
        engine, source = self.engine, self.source
        begun, used, shown = time.monotonic(), time.process_time(), -np.inf
        engine.start()
        while not (status := engine.status()).finished:
            time.sleep(0.5)
            self.samples.append((source.sent * 1e-6, resident()))
            if time.monotonic() - shown >= 10.0:
                shown = time.monotonic()
                print(
                    f"{source.seconds:6.0f} s of the asset, {source.sent:9,d} events, {resident():5.0f} MB, "
                    f"{HEALTH_NAMES[status.health]}, {len(engine.episodes())} episodes, {status.cause}",
                    flush=True,
                )
        took, used = time.monotonic() - begun, time.process_time() - used
        print(f"\n{source.seconds:.0f} s of the asset in {took:.0f} s ({used:.0f} s of the processor), ", end="")
        print(f"{source.sent / took:,.0f} events a second, {source.mixes} mixes of faults")
        # Episodes are updated every three seconds at least.
        time.sleep(MAX_EPISODES_PERIOD_S + 0.5)

    def account(self) -> None:
        """Every event is a row, was too late, or was refused for its time."""
        source, status, notes = self.source, self.engine.status(), self.engine.notices.counts()
        counts = status.counts
        rows = self.engine._log.first + self.engine._log.n
        stale, refused, held = notes.get("stale", 0), notes.get(WRONG_TIME, 0), counts.get("held", 0)
        left = source.sent - rows - stale - refused - held
        print(f"asset {source.made:,}, stamps {source.marks:,}, silenced {source.faults.lost:,}; sent {source.sent:,}")
        print(f"rows {rows:,} + stale {stale:,} + refused {refused:,} + held {held:,}: {left:,} missing")
        self._expect(left == 0, f"{left} events are not accounted for")
        verdicts = sum(counts.get(name, 0) for name in VERDICT_NAMES[1:])
        print(f"counts: {counts}")
        self._expect(verdicts == counts["readings"], f"verdicts sum up to {verdicts}, of {counts['readings']} readings")

    def memory(self) -> None:
        """A line through what was resident since the history was full."""
        x, y = np.array(self.samples).T
        settled = x > max(0.3 * x[-1], 5e-6 * self.engine.twin.config.history)
        if x[settled].size < LEAST:
            print("memory: too short a run to say")
            return
        slope, level = np.polyfit(x[settled], y[settled], 1)
        spread = np.std(y[settled] - slope * x[settled] - level)
        print(f"memory: {slope:+.2f} MB a million events from {x[settled][0]:.1f} million on, ", end="")
        print(f"residual {spread:.1f} MB, {y[-1]:.0f} MB at the end")
        self._expect(slope <= FLAT, f"memory grows by {slope:.2f} MB a million events; {FLAT:g} is allowed")

    def watch(self) -> None:
        """Who watches is still there, and the twin has come to itself."""
        status, alive = self.engine.status(), {thread.name for thread in threading.enumerate()}
        for name in ("engine", "job 0"):
            self._expect(name in alive, f"the thread {name} has ended")
        errors = self.engine.notices.counts().get("engine error", 0)
        self._expect(errors == 0, f"{errors} errors of the engine")
        health = HEALTH_NAMES[status.health]
        print(f"{len(self.engine.episodes())} episodes kept, {status.episodes_open} last; {health} {status.cause}")
        self._expect(status.health in (TRACKING, SUSPECT), f"{health} after {CALM:g} s without a fault")

    def _expect(self, right: bool, text: str) -> None:
        if not right:
            self.wrong.append(text)


def main() -> int:
    """Run it; 0 if nothing is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the asset")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    soak = Soak(given.seconds, given.seed)
    soak.run()
    soak.account()
    soak.memory()
    soak.watch()
    soak.engine.stop()
    for text in soak.wrong:
        print(f"FALLS SHORT: {text}")
    return 1 if soak.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
