"""`python -m tests.benchmarks.page [PART...]`: cost and latency of the page in Chromium.

`nisus run` runs in its own process, so that its processor time is measured apart from the browser's. Clock times on a
busy machine mean little; the load is printed with them.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import json
import os
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pyarrow.parquet

from app.record.reader import read_recording
from estimators.errors import SourceError
from estimators.log import READING
from tests.chromium import find_chromium, launched
from tests.extensions.fleet.test_command import FLEET, pump_rows, write

from .timing import BenchmarkRow, Bound, Section, run_sections

MOVES = 20

SLIDER = """async (value) => {
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
"""Type a value into the field of a slider, and return the milliseconds until the charts are redrawn."""


class Running:
    """`nisus run`, or another command with a page, in its own process."""

    def __init__(
        self, twin: str, *arguments: str, cache: Path | None = None, words: tuple[str, ...] = ("run", "--no-browser")
    ) -> None:
        environment = dict(os.environ) if cache is None else {**os.environ, "XDG_CACHE_HOME": str(cache)}
        command = [sys.executable, "-m", "app.cli.main", *words, twin, "--port", "0", *arguments]
        self.begun = time.monotonic()
        self._process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.url = next(found[0] for line in self._process.stdout if (found := re.search(r"http://\S+", line)))
        self.address, token = self.url.split("/?token=")
        self.headers = {"Authorization": f"Bearer {token}", "Origin": self.address}

    def ask(self, path: str, body: Any = None) -> Any:
        """Return an answer of the API."""
        return json.loads(self.text(path, body))

    def text(self, path: str, body: Any = None) -> str:
        """Return an answer as text."""
        data = None if body is None else json.dumps(body).encode()
        headers = self.headers | ({"Content-Type": "application/json"} if data else {})
        with urllib.request.urlopen(urllib.request.Request(self.address + path, data, headers)) as answer:
            return str(answer.read().decode())

    @property
    def readings(self) -> int:
        """Number of readings so far."""
        return int(self.ask("/api/status")["counts"]["readings"])

    def cpu(self) -> float:
        """Return processor seconds so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def resident(self) -> float:
        """Return resident memory, MB."""
        return int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def threads(self) -> int:
        """Return the number of threads."""
        return len(os.listdir(f"/proc/{self._process.pid}/task"))

    def handles(self) -> int:
        """Return the number of open file handles."""
        return len(os.listdir(f"/proc/{self._process.pid}/fd"))

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()


@contextmanager
def running(twin: str, *arguments: str, cache: Path | None = None) -> Iterator[Running]:
    """Run `nisus run` in the context."""
    run = Running(twin, *arguments, cache=cache)
    try:
        yield run
    finally:
        run.stop()


@contextmanager
def opened(run: Running) -> Iterator[tuple[Any, float]]:
    """Open the page in Chromium; give it once a curve is drawn, with the seconds until its charts appeared.

    Raises:
        SourceError: If there is no Chromium.
    """
    path = find_chromium()
    if path is None:
        raise SourceError("no Chromium was found")
    with launched(path) as browser:
        page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
        begun = time.monotonic()
        page.goto(run.url, wait_until="commit")
        page.wait_for_selector("#charts .chart canvas")
        paint = time.monotonic() - begun
        while not page.evaluate("window.nisus?.drawn > 0"):
            time.sleep(0.02)
        yield page, paint


def first() -> Iterator[BenchmarkRow]:
    """Start of motor_can from an empty compile cache, seconds."""
    with tempfile.TemporaryDirectory() as folder, running("motor_can", cache=Path(folder)) as run:
        figures = {"address [s]": time.monotonic() - run.begun}
        while run.ask("/api/status")["health"] == "waiting":
            time.sleep(0.02)
        figures["estimate [s]"] = time.monotonic() - run.begun
        with opened(run) as (_, figures["charts [s]"]):
            figures["first curve [s]"] = time.monotonic() - run.begun
        bounds = Bound("estimate [s]", 12.0), Bound("charts [s]", 1.5), Bound("first curve [s]", 20.0)
        yield BenchmarkRow("motor_can", figures, bounds)


ASSETS, ROWS, CLICKS = 200, 720, 8


def asset() -> Iterator[BenchmarkRow]:
    """From a click in the overview of a fleet to the charts of the asset with all its rows, seconds."""
    path = find_chromium()
    if path is None:
        raise SourceError("no Chromium was found")
    took = []
    with tempfile.TemporaryDirectory() as folder:
        rows = pump_rows(assets=ASSETS, count=ROWS)
        write(Path(folder) / "pumps.csv", rows)
        times: dict[str, list[float]] = {}
        for t, name, _ in rows:
            times.setdefault(name, []).append(t)
        fleet = Path(folder) / "pumps.yaml"
        fleet.write_text(FLEET.format(files="pumps.csv"))
        run = Running(str(fleet), words=("fleet",))
        try:
            with launched(path) as browser:
                page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
                for k in range(CLICKS + 1):
                    page.goto(run.url)
                    page.locator("#rows a").nth(k).wait_for()
                    time.sleep(1.0)
                    own = times[page.locator("#rows a").nth(k).inner_text().splitlines()[0]]
                    begun = time.monotonic()
                    page.locator("#rows a").nth(k).click()
                    page.wait_for_url("**/twins/*/", wait_until="commit")
                    # Its points are extremes of groups of rows, whose times may be a row before the newest.
                    until = own[-2] - own[0]
                    while not page.evaluate(f"window.nisus?.drawn > 0 && window.nisus.charts.live.x.at(-1) >= {until}"):
                        pass
                    took.append(time.monotonic() - begun)
        finally:
            run.stop()
    # The first also waits until the processes of pages can start.
    figures = {"median [s]": statistics.median(took[1:]), "shortest [s]": min(took[1:]), "first [s]": took[0]}
    yield BenchmarkRow(f"{ASSETS} assets, {ROWS} rows", figures, (Bound("median [s]", 1.0),))


MANY, MANY_ROWS, NEW_TABLES = 100_000, 20, 5


def overview() -> Iterator[BenchmarkRow]:
    """The overview of a fleet whose tables appear in a folder: first view, what it loads while all assets change."""
    path = find_chromium()
    if path is None:
        raise SourceError("no Chromium was found")
    names = np.array([f"pump {k}" for k in range(MANY)])
    rng = np.random.default_rng(3)
    with tempfile.TemporaryDirectory() as folder:
        tables = Path(folder) / "tables"
        tables.mkdir()

        def appear(first: int, rows: int) -> None:
            t = np.repeat(np.arange(first, first + rows), MANY) + rng.random(rows * MANY)
            columns = {"time": t, "pump": np.tile(names, rows), "temperature": 40.0 + 2.0 * rng.normal(size=t.size)}
            pyarrow.parquet.write_table(pyarrow.table(columns), tables / ".new")
            (tables / ".new").rename(tables / f"{first:06d}.parquet")

        appear(0, MANY_ROWS)
        fleet = Path(folder) / "pumps.yaml"
        fleet.write_text(FLEET.format(files="tables") + "  follow: true\n")
        run = Running(str(fleet), words=("fleet",))
        try:
            while run.ask("/api/fleet")["assets"] < MANY:
                time.sleep(0.2)
            time.sleep(2.0)
            with launched(path) as browser:
                page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
                loaded: list[float] = []
                network = page.context.new_cdp_session(page)
                network.on("Network.dataReceived", lambda data: loaded.append(data["encodedDataLength"]))
                network.send("Network.enable")
                begun = time.monotonic()
                page.goto(run.url, wait_until="commit")
                page.locator("#rows a").nth(10).wait_for()
                figures = {"first view [s]": time.monotonic() - begun}
                page.wait_for_timeout(2000.0)
                loaded.clear()
                begun = time.monotonic()
                for k in range(NEW_TABLES):
                    appear(MANY_ROWS + k, 1)
                    page.wait_for_timeout(2000.0)
                figures["kB/s"] = sum(loaded) / 1e3 / (time.monotonic() - begun)
                for k, name in enumerate(("first history [s]", "history [s]")):
                    page.goto(run.url)
                    page.locator("#rows a").nth(k).wait_for()
                    time.sleep(1.0)
                    begun = time.monotonic()
                    page.locator("#rows a").nth(k).click()
                    page.wait_for_url("**/twins/*/", wait_until="commit")
                    while not page.evaluate("window.nisus?.drawn > 0"):
                        pass
                    figures[name] = time.monotonic() - begun
                figures["resident [MB]"] = run.resident()
        finally:
            run.stop()
    bounds = Bound("first view [s]", 2.0), Bound("kB/s", 20.0), Bound("history [s]", 1.0)
    yield BenchmarkRow(f"{MANY:,} assets", figures, bounds)


def slider() -> Iterator[BenchmarkRow]:
    """From a slider to the redrawn charts, without Explore, ms."""
    for events, bound in ((10_000, 150.0), (100_000, 400.0)):
        # One reading in fifteen is lost.
        with running("motor_winding", "--speed", "inf", "--set", f"source.duration={events * 15 / 14:.0f}") as run:
            with opened(run) as (page, paint):
                while not run.ask("/api/status")["finished"]:
                    time.sleep(0.1)
                time.sleep(3.0)
                took = [page.evaluate(SLIDER, 0.01 * (1.0 + 0.1 * k)) for k in range(MOVES)]
            figures = {"median [ms]": statistics.median(took), "longest [ms]": max(took), "charts [s]": paint}
            yield BenchmarkRow(f"{events:,} readings", figures, (Bound("median [ms]", bound),))


def share(seconds: float = 15.0) -> Iterator[BenchmarkRow]:
    """Share of a processor that the server takes, with one browser and with none."""
    with running("motor_can") as run:
        with opened(run):
            time.sleep(15.0)
            cpu, begun = run.cpu(), time.monotonic()
            time.sleep(seconds)
            percent = 100.0 * (run.cpu() - cpu) / (time.monotonic() - begun)
            yield BenchmarkRow("one browser", {"of a core [%]": percent}, (Bound("of a core [%]", 8.0),))
        time.sleep(2.0)
        cpu, begun = run.cpu(), time.monotonic()
        time.sleep(seconds / 2)
        yield BenchmarkRow("none", {"of a core [%]": 100.0 * (run.cpu() - cpu) / (time.monotonic() - begun)})


async def _watch(run: Running, seconds: float) -> int:
    import websockets

    columns = run.ask("/api/model")["columns"]
    address = run.address.replace("http", "ws", 1)
    headers = {"Authorization": run.headers["Authorization"]}
    got, end = 0, time.monotonic() + seconds
    origin: Any = run.address
    async with websockets.connect(address + "/api/stream", additional_headers=headers, origin=origin) as stream:
        await stream.send(json.dumps({"streams": {"charts": {"columns": columns, "span": 120, "points": 600}}}))
        while time.monotonic() < end:
            try:
                message = await asyncio.wait_for(stream.recv(), 1.0)
            except TimeoutError:
                continue
            got += len(message)
            if isinstance(message, str) and "frames" in message:
                await stream.send('{"drawn":true}')
    return got


def crowd(seconds: float = 15.0) -> Iterator[BenchmarkRow]:
    """Load of 0, 1 and 10 clients at a thousand readings per second."""
    with running("motor_can", "--set", "source.asset.step=0.003") as run:
        time.sleep(3.0)
        for clients in (0, 1, 10, 0):

            async def all_of_them(count: int = clients) -> int:
                return sum(await asyncio.gather(*(_watch(run, seconds) for _ in range(count))))

            readings, cpu, begun, sent = run.readings, run.cpu(), time.monotonic(), 0
            if clients:
                sent = asyncio.run(all_of_them())
            else:
                time.sleep(seconds)
            gone = time.monotonic() - begun
            status = run.ask("/api/status")
            figures = {
                "rows per s": (status["counts"]["readings"] - readings) / gone,
                "p99 to row [ms]": status["latency_ms"],
                "of a core [%]": 100.0 * (run.cpu() - cpu) / gone,
                "sent [kB/s]": sent / gone / 1000,
            }
            yield BenchmarkRow(f"{clients} clients", figures)


def arrival(seconds: float = 15.0) -> Iterator[BenchmarkRow]:
    """From arrival to row at 1 kHz with a browser and a recording, p99 over 4096 readings, ms; steps late or lost."""
    step = 0.003
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "live.rrd"
        with running("motor_can", "--set", f"source.asset.step={step}", "--record", str(path)) as run, opened(run):
            worst = []
            for _ in range(max(1, int(seconds / 4))):
                time.sleep(4.0)
                worst.append(run.ask("/api/status")["latency_ms"])
        events = read_recording(path).events
    # Steps are apart by a fixed time, so a lost one leaves a gap; a busy machine sends some late.
    gaps = np.diff(np.unique(events.t[events.kind == READING])) > (1.5 * step + 0.02) * 1e9
    figures = {"median [ms]": statistics.median(worst), "longest [ms]": max(worst), "gaps": int(gaps.sum())}
    yield BenchmarkRow("motor_can", figures, (Bound("median [ms]", 5.0),))


def memory(edits: int = 60) -> Iterator[BenchmarkRow]:
    """Resident memory of the server process: after a minute, and with a page after the start and after edits, MB."""
    with running("motor_can") as run:
        time.sleep(60.0)
        yield BenchmarkRow("after a minute, no page", {"RSS [MB]": run.resident()}, (Bound("RSS [MB]", 250.0),))
    with running("motor_can") as run, opened(run) as (page, _):
        time.sleep(20.0)
        begun = run.resident()
        yield BenchmarkRow("after the start", {"RSS [MB]": begun}, (Bound("RSS [MB]", 350.0),))
        for k in range(edits):
            page.evaluate(SLIDER, 0.01 * (1.0 + k % 7))
        more = {"RSS [MB]": run.resident(), "more [MB]": run.resident() - begun}
        yield BenchmarkRow(f"after {edits} edits", more, (Bound("more [MB]", 50.0),))


def published(seconds: float = 15.0, rate: float = 1000.0) -> Iterator[BenchmarkRow]:
    """From a measurement by MQTT, POST, CAN or OPC UA to the state that contains it, received through a broker, ms.

    The twin also has the outputs OPC UA and CAN. OPC UA servers publish every 10 ms, and the last value only.

    Raises:
        SourceError: If there is no Mosquitto.
    """
    from app.extensions.mqtt.client import mqtt_client
    from tests.extensions.mqtt.broker import Broker
    from tests.extensions.test_one_state import Plant

    from ..skips import find_program
    from ..support import free_port

    if find_program("mosquitto") is None:
        raise SourceError("no mosquitto was found")
    for kind in ("mqtt", "push", "can", "opcua"):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            broker = Broker(folder)
            plant, place = Plant(folder, broker), {"host": "127.0.0.1", "port": broker.port}
            multicast = {"interface": "udp_multicast", "channel": "239.74.163.10"}
            bus = {**multicast, "options": {"port": free_port(socket.SOCK_DGRAM)}}
            source = plant.source(kind) | {"mqtt": {"qos": 0}, "can": bus}.get(kind, {})
            can_output = {**bus, "id": 1536, "dbc": str(folder / "estimate.dbc")}
            outputs = {"every": 0, "mqtt": place, "opcua": {"port": free_port()}, "can": can_output}
            given = {"source": json.dumps(source), "outputs": json.dumps(outputs)}
            options = [f"--set={key}={value}" for key, value in given.items()]
            delays: list[float] = []

            def heard(_client: Any, _data: Any, message: Any, delays: list[float] = delays) -> None:
                now, found = time.time_ns(), json.loads(message.payload)
                delays.append((now - found["time_ns"]) * 1e-6 if found["time_ns"] else np.nan)

            client = mqtt_client(SimpleNamespace(user=None, ca_file=None), None, client_id="")  # type: ignore[arg-type]
            client.on_message = heard
            try:
                with running("motor_winding", *options) as run, _sender(kind, plant, client, run, bus) as send:
                    client.connect("127.0.0.1", broker.port)
                    client.subscribe("nisus/+/state")
                    client.loop_start()
                    while not all(item["connected"] for item in run.ask("/api/alerts")["outputs"]):
                        time.sleep(0.1)
                    for part in (3.0, seconds):  # the first part warms up
                        delays.clear()
                        cpu, begun, sent = run.cpu(), time.monotonic(), 0
                        while (gone := time.monotonic() - begun) < part:
                            while sent < gone * rate and time.monotonic() - begun < part:
                                send(40.0 + sent % 3)
                                sent += 1
                            time.sleep(0.5 / rate)
                    taken = np.array(delays)
                    figures = {
                        "p50 [ms]": float(np.nanpercentile(taken, 50)),
                        "p99 [ms]": float(np.nanpercentile(taken, 99)),
                        "p99 to row [ms]": run.ask("/api/status")["latency_ms"],
                        "sent per s": sent / seconds,
                        "states per s": taken.size / seconds,
                        "of a core [%]": 100.0 * (run.cpu() - cpu) / seconds,
                    }
            finally:
                client.loop_stop()
                plant.close()
                broker.stop()
        yield BenchmarkRow(f"{kind} to MQTT", figures, (Bound("p99 [ms]", 5.0),))


@contextmanager
def _sender(kind: str, plant: Any, client: Any, run: Running, bus: Any) -> Iterator[Callable[[float], object]]:
    """Give the function that sends a measurement with the present time; of CAN the kernel's time counts."""
    if kind == "mqtt":
        yield lambda value: client.publish("plant/t", json.dumps({"v": value, "t": time.time()}))
    elif kind == "push":
        connection = http.client.HTTPConnection(run.address.removeprefix("http://"))
        headers = run.headers | {"Content-Type": "application/json"}

        def post(value: float) -> None:
            body = json.dumps({"time": time.time_ns(), "values": {"winding": value}})
            connection.request("POST", "/api/readings", body, headers)
            connection.getresponse().read()

        yield post
        connection.close()
    elif kind == "can":
        with can.Bus(interface=bus["interface"], channel=bus["channel"], **bus["options"]) as sender:
            yield lambda value: sender.send(
                can.Message(arbitration_id=256, data=struct.pack("<fI", value, 0), is_extended_id=False)
            )
    else:
        from asyncua import ua

        def write(value: float) -> None:
            stamp = datetime.now(UTC)
            plant.node.write_value(ua.DataValue(ua.Variant(value), SourceTimestamp=stamp))

        yield write


_PARTS = (crowd, first, slider, share, arrival, published, memory, asset, overview)
PARTS: dict[str, Section] = {part.__name__: part for part in _PARTS}


def page() -> Iterator[BenchmarkRow]:
    """Cost and latency of the page: see `python -m tests.benchmarks.page`."""
    for name, part in PARTS.items():
        for row in part():
            yield row._replace(name=f"{name}, {row.name}")


def main() -> None:
    """Run the parts that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"among {', '.join(PARTS)}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to this file")
    given = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    run_sections([PARTS[name] for name in given.parts], given.json)


if __name__ == "__main__":
    main()
