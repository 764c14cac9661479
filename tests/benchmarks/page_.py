"""`python -m tests.benchmarks.page_`: what the page costs, and how long a person waits for it, in Chromium.

The program runs in a process of its own, as `nisus run` starts it, so that what it takes of a processor is told from
what browser and measurement take. On a busy machine times of the clock say little; the load stands beside them.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.chromium import find_chromium, launched

from .timing import judged

MOVES = 20

HISTORY = 20_000
"""Events that are kept in a soak: so many come in less than two minutes, after which memory must stay."""

KNOB = """async (value) => {
  const box = document.querySelector('.knob[data-key^="Q."] .field input');
  const before = window.nisus.revision, begun = performance.now();
  box.value = String(value);
  box.dispatchEvent(new Event('change'));
  await new Promise((done) => {
    const over = () => window.nisus.revision > before || performance.now() - begun > 20000;
    const look = () => (over() ? done() : requestAnimationFrame(look));
    look();
  });
  return performance.now() - begun;
}"""
"""Types a value into the line of a knob, and gives the milliseconds until the charts have been drawn anew."""


class Running:
    """`nisus run` in a process of its own."""

    def __init__(self, twin: str, *arguments: str, cache: Path | None = None) -> None:
        environment = dict(os.environ) if cache is None else {**os.environ, "XDG_CACHE_HOME": str(cache)}
        command = [sys.executable, "-m", "app.cli.main", "run", twin, "--port", "0", "--no-browser", *arguments]
        self.begun = time.monotonic()
        self._process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.url = next(found[0] for line in self._process.stdout if (found := re.search(r"http://\S+", line)))
        self.address, token = self.url.split("/?token=")
        self.headers = {"Authorization": f"Bearer {token}", "Origin": self.address}

    def ask(self, path: str, body: Any = None) -> Any:
        """An answer of the API."""
        data = None if body is None else json.dumps(body).encode()
        headers = self.headers | ({"Content-Type": "application/json"} if data else {})
        with urllib.request.urlopen(urllib.request.Request(self.address + path, data, headers)) as answer:
            return json.loads(answer.read())

    @property
    def readings(self) -> int:
        """Rows of readings so far."""
        return int(self.ask("/api/status")["counts"]["readings"])

    def cpu(self) -> float:
        """Seconds of a processor so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def resident(self) -> float:
        """Resident memory, MB."""
        return int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()


@contextmanager
def running(twin: str, *arguments: str, cache: Path | None = None) -> Iterator[Running]:
    """`nisus run` meanwhile."""
    run = Running(twin, *arguments, cache=cache)
    try:
        yield run
    finally:
        run.stop()


@contextmanager
def browsing() -> Iterator[Any]:
    """Chromium meanwhile; None where there is none."""
    path = find_chromium()
    if path is None:
        print("no Chromium: left out")
        yield None
        return
    with launched(path) as browser:
        yield browser


def opened(browser: Any, url: str) -> tuple[Any, float]:
    """A page, and the seconds from the address to its charts."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    begun = time.monotonic()
    page.goto(url, wait_until="commit")
    page.wait_for_selector("#charts .chart canvas")
    return page, time.monotonic() - begun


def drawn(page: Any) -> None:
    """Wait until there is a curve."""
    while not page.evaluate("window.nisus?.drawn > 0"):
        time.sleep(0.02)


def first_use(browser: Any) -> None:
    """From an empty cache."""
    print("motor_can from an empty cache")
    with tempfile.TemporaryDirectory() as folder, running("motor_can", cache=Path(folder)) as run:
        print(f"  address printed after {time.monotonic() - run.begun:.1f} s")
        page, paint = opened(browser, run.url)
        print(f"  page and charts {paint:.2f} s after the address was opened: {judged(paint, 1.5, at_least=False)}")
        drawn(page)
        took = time.monotonic() - run.begun
        print(f"  charts move {took:.1f} s after the command: {judged(took, 20.0, at_least=False)}")


def knob(browser: Any) -> None:
    """From a knob to the redrawn charts, without Explore."""
    for events, bound in ((10_000, 150.0), (100_000, 400.0)):
        # One reading in fifteen is lost.
        with running("motor_winding", "--speed", "inf", "--set", f"source.duration={events * 15 / 14:.0f}") as run:
            page, paint = opened(browser, run.url)
            drawn(page)
            while not run.ask("/api/status")["finished"]:
                time.sleep(0.1)
            time.sleep(3.0)
            took = [page.evaluate(KNOB, 0.01 * (1.0 + 0.1 * k)) for k in range(MOVES)]
            middle = statistics.median(took)
            print(
                f"knob to redrawn charts on {run.readings} readings: median {middle:.0f} ms, {min(took):.0f} to "
                f"{max(took):.0f}: {judged(middle, bound, at_least=False)}; page and charts after {paint:.2f} s"
            )


def share(browser: Any, seconds: float) -> None:
    """What the server takes of a processor with one browser, its charts and its scene."""
    with running("motor_can") as run:
        page, paint = opened(browser, run.url)
        drawn(page)
        time.sleep(15.0)
        cpu, begun = run.cpu(), time.monotonic()
        time.sleep(seconds)
        percent = 100.0 * (run.cpu() - cpu) / (time.monotonic() - begun)
        print(f"motor_can with a browser: {percent:.1f} % of a core: {judged(percent, 8.0, at_least=False)}", end="")
        page.close()
        time.sleep(2.0)
        cpu, begun = run.cpu(), time.monotonic()
        time.sleep(seconds / 2)
        print(f"; {100.0 * (run.cpu() - cpu) / (time.monotonic() - begun):.1f} % with none; opened in {paint:.2f} s")


async def _look_on(run: Running, seconds: float) -> int:
    import websockets

    columns = run.ask("/api/model")["columns"]
    address = run.address.replace("http", "ws", 1)
    headers = {"Authorization": run.headers["Authorization"]}
    got, end = 0, time.monotonic() + seconds
    origin: Any = run.address
    async with websockets.connect(address + "/api/stream", additional_headers=headers, origin=origin) as stream:
        await stream.send(json.dumps({"lanes": {"charts": {"columns": columns, "span": 120, "points": 600}}}))
        while time.monotonic() < end:
            try:
                message = await asyncio.wait_for(stream.recv(), 1.0)
            except TimeoutError:
                continue
            got += len(message)
            if isinstance(message, str) and "frames" in message:
                await stream.send('{"drawn":true}')
    return got


def crowd(seconds: float) -> None:
    """Whether ten that look on slow the engine: a thousand readings a second, with none and with ten."""
    with running("motor_can", "--set", "source.asset.step=0.003") as run:
        time.sleep(3.0)
        for lookers in (0, 1, 10, 0):

            async def all_of_them(count: int = lookers) -> int:
                return sum(await asyncio.gather(*(_look_on(run, seconds) for _ in range(count))))

            readings, cpu, begun = run.readings, run.cpu(), time.monotonic()
            if lookers:
                sent = asyncio.run(all_of_them())
            else:
                sent = 0
                time.sleep(seconds)
            gone = time.monotonic() - begun
            status = run.ask("/api/status")
            rate = (status["counts"]["readings"] - readings) / gone
            print(
                f"{lookers:2} look on at 1 kHz: {rate:.0f} rows/s, p99 from arrival to row {status['latency_ms']:.1f} "
                f"ms, {100.0 * (run.cpu() - cpu) / gone:.0f} % of a core, {sent / gone / 1000:.0f} kB/s"
            )


def arrival(browser: Any, seconds: float) -> None:
    """From arrival to row at 1 kHz with a browser."""
    with running("motor_can", "--set", "source.asset.step=0.003") as run:
        page, _ = opened(browser, run.url)
        drawn(page)
        worst = []
        for _ in range(max(1, int(seconds / 4))):
            time.sleep(4.0)
            worst.append(run.ask("/api/status")["latency_ms"])
        middle = statistics.median(worst)
        print(
            f"arrival to row at 1 kHz with a browser, p99 over 4096 readings: median {middle:.1f} ms, {min(worst):.1f} "
            f"to {max(worst):.1f}: {judged(middle, 5.0, at_least=False)}"
        )


def soak(browser: Any, minutes: float) -> None:
    """Memory of server and page at 200 readings a second with 10,000 particles, and a history that is soon full."""
    options = ("--estimator", "pf", "--set", 'filters.pf={"particles": 10000}', "--set", "source.asset.step=0.015",
               "--set", f"history={HISTORY}")  # fmt: skip
    with running("motor_can", *options) as run:
        page, _ = opened(browser, run.url)
        drawn(page)
        session = page.context.new_cdp_session(page)
        begun, before = time.monotonic(), run.readings
        print(f"{'min':>5} {'readings/s':>10} {'server MB':>9} {'heap MB':>8} {'p99 ms':>7}")
        while (gone := time.monotonic() - begun) < 60.0 * minutes:
            time.sleep(30.0)
            session.send("HeapProfiler.collectGarbage")
            heap = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
            gone, status = time.monotonic() - begun, run.ask("/api/status")
            rate = (status["counts"]["readings"] - before) / gone
            line = f"{gone / 60:5.1f} {rate:10.0f} {run.resident():9.0f} {heap:8.1f} {status['latency_ms']:7.1f}"
            print(line, flush=True)


PARTS = ("first", "knob", "share", "crowd", "arrival")


def measure(parts: Sequence[str], seconds: float, minutes: float) -> None:
    """Some of the above."""
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    if "crowd" in parts:
        crowd(seconds)
    with browsing() as browser:
        known: dict[str, Callable[[], None]] = {
            "first": lambda: first_use(browser),
            "knob": lambda: knob(browser),
            "share": lambda: share(browser, seconds),
            "arrival": lambda: arrival(browser, seconds),
            "soak": lambda: soak(browser, minutes),
        }
        for part in parts if browser is not None else ():
            if part in known:
                known[part]()
                print(f"  load {os.getloadavg()[0]:.1f}", flush=True)


def page() -> None:
    """What the page costs, and how long a person waits for it."""
    measure(PARTS, 15.0, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=PARTS, help="among first, knob, share, crowd, arrival and soak")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each part")
    parser.add_argument("--minutes", type=float, default=10.0, help="of the part `soak`")
    given = parser.parse_args()
    measure(given.parts, given.seconds, given.minutes)


if __name__ == "__main__":
    main()
