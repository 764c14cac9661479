"""`python -m tests.benchmarks.live`: a thousand readings a second for a minute, with page, browser and recording.

Prints losses, latency from arrival to track row, and memory; then moves a slider on what has come to be a long history.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from app.cli.prepare import prepare
from app.cli.run import live_source
from app.live import commands
from app.twin.twin import load_twin
from app.views.recording.reader import read_recording
from app.web.session import Page, Session
from estimators.log import READING
from tests.chromium import find_chromium, launched

STEP = 0.003
"""Seconds between the asset's steps, each of three readings."""

SLACK = 20e6
"""Nanoseconds by which a busy machine may send a frame late."""


def resident() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-browser", action="store_true")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp())
    twin = load_twin("motor_can", overrides={"source.asset.step": str(STEP)})
    prepare(twin)
    session = Session(twin, live_source(twin, 1.0), page=Page(0, open_browser=False))
    engine = session.engine
    player = engine._feeder.source._inner._player  # type: ignore[attr-defined]
    session.start()
    engine.submit(commands.Record(folder / "live.rrd"))
    path = None if given.no_browser else find_chromium()
    closing = ExitStack()
    if path is not None:
        page = closing.enter_context(launched(path)).new_page(viewport={"width": 1500, "height": 950})
        page.goto(session.url)
        while not page.evaluate("window.nisus?.drawn > 0"):
            time.sleep(0.5)
    cpu = os.times()
    begun = time.monotonic()
    seen = engine.status().counts["readings"]
    print(f"{'s':>4} {'readings':>9} {'p50 ms':>7} {'p99 ms':>7} {'MB':>6}")
    while (gone := time.monotonic() - begun) < given.seconds:
        time.sleep(5.0)
        status = engine.status()
        print(
            f"{gone + 5:4.0f} {status.counts['readings']:9d} {status.latency_p50_ms:7.2f} {status.latency_ms:7.2f} "
            f"{resident():6.0f}",
            flush=True,
        )
    used = os.times()
    share = (used.user + used.system - cpu.user - cpu.system) / (time.monotonic() - begun)
    rate = (engine.status().counts["readings"] - seen) / (time.monotonic() - begun)
    print(f"{rate:.0f} readings/s, {100 * share:.0f} % of a core, load {os.getloadavg()[0]:.1f}")
    if path is not None:
        print(f"pictures drawn in the browser: {page.evaluate('window.nisus.drawn')}")

    for value in (0.02, 0.03, 0.05):
        while engine.status().refolding:
            time.sleep(0.05)
        events = engine.status().counts["readings"]
        revision = engine._revision
        begun = time.monotonic()
        engine.submit(commands.SetTuning("Q.winding", value))
        while engine._revision == revision:
            time.sleep(0.002)
        took = time.monotonic() - begun
        print(f"slider on {events} readings: folded again in {took:.3f} s", end="")
        if path is not None:
            while page.evaluate("window.nisus.revision") == revision:
                time.sleep(0.01)
            arrived = time.monotonic() - begun
            drawn = page.evaluate("window.nisus.drawn")
            while page.evaluate("window.nisus.drawn") == drawn:
                time.sleep(0.01)
            print(f", in the browser after {arrived:.2f} s, drawn after {time.monotonic() - begun:.2f} s", end="")
        print()

    player.close()
    time.sleep(1.0)
    engine.status()
    time.sleep(0.2)
    cursor = engine.cursor()
    readings = engine.pull(cursor).events
    engine.release(cursor)
    came = engine.status().counts["readings"]
    # Every step sends one frame of three readings, and steps are apart by a fixed time: a lost one leaves a gap.
    steps = np.unique(readings.t[readings.kind == READING])
    gaps = int(np.sum(np.diff(steps) > 1.5 * STEP * 1e9 + SLACK))
    print(f"{player.sent} frames sent, {came} readings came, {gaps} steps late or lost")
    session.stop()
    recorded = read_recording(folder / "live.rrd")
    print(f"recorded readings {int(np.sum(recorded.events.kind == READING))}, health of it: {engine.status().counts}")
    closing.close()
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
