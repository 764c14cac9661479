"""`python -m tests.benchmarks.soak`: does anything grow? It exits with 1 if anything does, or is wrong.

With `--minutes 60`, an hour of `nisus run motor_can` with its page open in Chromium: an edit every 20 seconds, Explore
shown and hidden, recordings started and stopped. A line a minute has memory, threads and file handles of the server
process; the end has their slopes with standard errors, from the minute in which the history is full: until then each
event adds its row to the log, the track and what shows them. `--history` is its length in events.

With `--service` as well, the same without a page: 100 measurements a second, recorded, archived and scraped as metrics,
where recordings and archive are split and removed as they grow; disk use is watched, too.

With `--seconds 3600`, the default: an hour at 1 kHz of the worst mix of faults, as fast as possible. The engine runs
without a page on a simulated asset; every few seconds of the asset's time some faults of all kinds begin, which last
for some seconds. At the end every event must be accounted for, memory must have stayed flat once the history was full,
and what watches the twin must still be there.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from app.engine.engine import Engine
from app.engine.episode_log import MAX_EPISODES_PERIOD_S
from app.extensions.lab.stress.scenario import asset_of
from app.twin.twin import Twin, load_twin
from estimators.log import MARK, Events
from estimators.track import ADVISORY, HEALTH_NAMES, SUSPECT, TRACKING, VERDICT_NAMES
from sources.faults.kinds import Fault
from sources.faults.layer import Faults
from sources.source import WRONG_TIME

from .page import SLIDER, Running, opened, running

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


class Watched(NamedTuple):
    """A figure of the server process, and by how much it may grow in an hour."""

    name: str
    unit: str
    per_hour: float


WATCHED = (Watched("memory", "MB", 15.0), Watched("threads", "", 1.0), Watched("handles", "", 2.0))
"""Resident memory (RSS) of the server process alone, without browser and compilers."""

WATCHED_SERVICE = (*WATCHED, Watched("disk", "MB", 5.0))
KEPT_MB = 10  # of recordings, and of the archive
SPLIT = "2min"
SERVICE_STEP = 0.03  # seconds between the asset's steps, each of three readings
SCRAPE_PERIOD_S = 10.0

EDIT_PERIOD_S, EXPLORE_PERIOD_S, RECORDING_PERIOD_S = 20.0, 120.0, 90.0
SAMPLE_PERIOD_S = 1.0
ACTION_TIMEOUT_MS = 600_000  # of a click, on a busy machine without a graphics card
MINUTE_S = 60.0

SETTLING_S = 600.0
"""Earliest start of the slopes. Rerun's threads keep heaps of their own, which have their size after some showings of
Explore and some recordings: in an hour the means of four minutes were 539, 546 and then 544 to 554 MB."""

HISTORY_EVENTS = 20_000
"""Events that the soaked twin keeps: motor_can has that many after five minutes, 200,000 after fifty."""

CYCLE_MINUTES = round(2.0 * EXPLORE_PERIOD_S / MINUTE_S)
"""Explore is shown for half of these, with threads of its own: slopes are of means over whole cycles."""

MIN_MINUTES = 3 * CYCLE_MINUTES  # Of a slope


def slope(minutes: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the slope per hour of a line through values a minute apart, and its standard error.

    The error allows for residuals that are correlated from one minute to the next (an AR(1) process).
    """
    hours = minutes / 60.0
    centred = hours - hours.mean()
    rate = float(centred @ values / (centred @ centred))
    left = values - values.mean() - rate * centred
    spread = float(left @ left) / max(1, len(left) - 2)
    lag = float(np.clip(left[1:] @ left[:-1] / (left @ left), 0.0, 0.9)) if spread > 0.0 else 0.0
    return rate, float(np.sqrt(spread / (centred @ centred) * (1.0 + lag) / (1.0 - lag)))


class PageSoak:
    """A server with a page that is used: edits, Explore and recordings, each with a period of its own."""

    watched: tuple[Watched, ...] = WATCHED

    def __init__(self, run: Running, page: Any, folder: Path, history: int) -> None:
        self.run, self.page, self.folder, self.history = run, page, folder, history
        self.full: int | None = None
        """Minute by which the history was full."""
        self.samples: list[tuple[float, ...]] = []
        self.edits = self.recordings = self.explored = 0

    def done(self) -> dict[str, int]:
        """Return how often each thing was done."""
        return {"edits": self.edits, "Explore": self.explored, "recordings": self.recordings}

    def figures(self) -> tuple[float, ...]:
        """Return memory, threads and handles of the server."""
        return self.run.resident(), self.run.threads(), self.run.handles()

    def act(self, seconds: float) -> None:
        """Do what is due by now, on the page."""
        if seconds >= EDIT_PERIOD_S * (self.edits + 1):
            self.edits += 1
            self.page.evaluate(SLIDER, 0.01 * (1.0 + self.edits % 7))
        if seconds >= EXPLORE_PERIOD_S * self.explored + 30.0:
            self.explored += 1
            self.page.click("[data-tab=explore]")
        if seconds >= RECORDING_PERIOD_S * self.recordings + 45.0:
            self.recordings += 1
            self.page.click("#record")
            for done in sorted(self.folder.glob("*.rrd"), key=lambda path: path.stat().st_mtime)[:-2]:
                done.unlink()

    def use(self, minutes: float) -> None:
        """Use the page, and print a line a minute: the median of its seconds."""
        begun, minute, kept = time.monotonic(), list[tuple[float, ...]](), 0
        heads = [f"{item.name} [{item.unit}]" if item.unit else item.name for item in self.watched]
        print("  min", *(f"{head:>11s}" for head in (*heads, *self.done(), "rows kept")))
        while (seconds := time.monotonic() - begun) < 60.0 * minutes:
            self.act(seconds)
            minute.append(self.figures())
            if seconds >= MINUTE_S * (len(self.samples) + 1):
                self.samples.append(tuple(np.median(minute, axis=0)))
                minute.clear()
                rows = self.run.ask("/api/status")["counts"]["readings"]
                if self.full is None and (rows < kept or rows >= self.history):
                    self.full = len(self.samples)  # the oldest have been dropped
                kept = rows
                cells = [f"{value:11.1f}" for value in self.samples[-1]]
                cells += [f"{count:11,d}" for count in (*self.done().values(), rows)]
                print(f"  {len(self.samples):3d}", *cells, flush=True)
            time.sleep(SAMPLE_PERIOD_S)

    def verdict(self) -> list[str]:
        """Print the slopes, and return those that are not below their bounds by two standard errors."""
        if self.full is None:
            return [f"the history of {self.history:,} events is not full; soak for longer, or with a shorter --history"]
        late = np.arange(len(self.samples)) >= max(self.full, SETTLING_S / MINUTE_S)
        print(f"slopes from minute {int(np.argmax(late)) + 1} on; the history was full by minute {self.full}")
        minutes, wrong = np.flatnonzero(late).astype(float), list[str]()
        if minutes.size < MIN_MINUTES:
            return [f"{minutes.size} minutes after the start settled are too few for a slope; {MIN_MINUTES} are needed"]
        whole = minutes.size // CYCLE_MINUTES * CYCLE_MINUTES
        for item, values in zip(self.watched, np.array(self.samples)[late].T, strict=True):
            cycles = (column[:whole].reshape(-1, CYCLE_MINUTES).mean(axis=1) for column in (minutes, values))
            rate, error = slope(*cycles)
            unit = f"{item.unit}/h".lstrip()
            print(f"{item.name}: {rate:+.2f} ± {error:.2f} {unit}, bound {item.per_hour:g}; last {values[-1]:.1f}")
            if rate + 2.0 * error > item.per_hour:
                wrong.append(f"{item.name} grows by {rate:.2f} ± {error:.2f} {unit}; {item.per_hour:g} is allowed")
        return wrong


def soak_page(minutes: float, history: int) -> list[str]:
    """Run it, and return what falls short."""
    with tempfile.TemporaryDirectory() as name:
        with running(TWIN, "--recordings", name, "--set", f"history={history}") as run, opened(run) as (page, _):
            page.set_default_timeout(ACTION_TIMEOUT_MS)
            soak = PageSoak(run, page, Path(name), history)
            soak.use(minutes)
            return soak.verdict()


class ServiceSoak(PageSoak):
    """A server without a page, with recordings, an archive and metrics."""

    watched = WATCHED_SERVICE

    def __init__(self, run: Running, folder: Path, history: int) -> None:
        super().__init__(run, None, folder, history)
        self.scrapes = 0

    def done(self) -> dict[str, int]:
        """Return the number of scrapes, and of files."""
        return {"scrapes": self.scrapes, "files": len(self._sizes())}

    def figures(self) -> tuple[float, ...]:
        """Return memory, threads and handles of the server, and what its files take."""
        return *super().figures(), 1e-6 * sum(self._sizes())

    def act(self, seconds: float) -> None:
        """Scrape the metrics when that is due."""
        if seconds >= SCRAPE_PERIOD_S * (self.scrapes + 1):
            self.scrapes += 1
            assert "nisus_" in self.run.text("/metrics?states=true")

    def _sizes(self) -> list[int]:
        """Sizes of all files that are there; one may be removed meanwhile."""
        found = []
        for path in self.folder.rglob("*"):
            with suppress(FileNotFoundError):
                found += [path.stat().st_size] if path.is_file() else []
        return found


def soak_service(minutes: float, history: int) -> list[str]:
    """Run it, and return what falls short."""
    with tempfile.TemporaryDirectory() as name:
        record = [f"--record={name}/run.rrd", f"--record-split={SPLIT}", f"--record-keep={KEPT_MB}MB"]
        archive = [f"--archive={name}/archive", f"--archive-split={SPLIT}", f"--archive-keep={KEPT_MB}MB"]
        settings = [f"--set=history={history}", f"--set=source.asset.step={SERVICE_STEP}"]
        with running(TWIN, "--recordings", name, *record, *archive, *settings) as run:
            soak = ServiceSoak(run, Path(name), history)
            soak.use(minutes)
            return soak.verdict()


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
        self._expect(status.health in (TRACKING, ADVISORY, SUSPECT), f"{health} after {CALM:g} s without a fault")

    def _expect(self, right: bool, text: str) -> None:
        if not right:
            self.wrong.append(text)


def main() -> int:
    """Run it; 0 if nothing is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, help="soak server and page for so long instead")
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the asset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--history", type=int, default=HISTORY_EVENTS, help="events that the twin with a page keeps")
    parser.add_argument("--service", action="store_true", help="with --minutes: without a page, with files and metrics")
    given = parser.parse_args()
    if given.minutes is not None:
        wrong = (soak_service if given.service else soak_page)(given.minutes, given.history)
        for text in wrong:
            print(f"FALLS SHORT: {text}")
        return 1 if wrong else 0
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
