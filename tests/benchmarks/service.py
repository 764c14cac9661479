"""`python -m tests.benchmarks.service --twins 20 --minutes 5`: cost of twins at 10 Hz in one service, one crashing.

Each minute the process of one twin is killed, of every tenth in turn; the others must go on in their processes. It
prints the time until all run (compiled before), processor and memory per twin, and the time in which the killed one
runs again. It exits with 1 if another one was started again, or one did not measure at 10 Hz.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests import ROOT
from tests.extensions.service.test_service import Served, all_run

RATE_HZ, MIN_SHARE = 10.0, 0.9
KILL_PERIOD_S = 60.0


def write_twins(folder: Path, count: int) -> None:
    """Write YAML files of simulated twins at 10 Hz."""
    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    for old, new in (("step: 1.0 ", f"step: {1.0 / RATE_HZ} "), ("duration: 120 ", "duration: 360000 ")):
        assert old in text
        text = text.replace(old, new)
    for k in range(count):
        (folder / f"twin_{k:02d}.yaml").write_text(text)


def measure(count: int, seconds: float, folder: Path) -> list[str]:
    """Run the service, print its costs, and return what was wrong."""
    (folder / "twins").mkdir()
    write_twins(folder / "twins", count)
    begun = time.monotonic()
    service = Served(folder, "twins", "--store", "stores")
    wrong: list[str] = []
    try:
        for least in range(1, count + 1):  # they start one after the other, each within the limit of a wait
            service.wait(lambda twins, n=least: sum(twin["state"] == "running" for twin in twins.values()) >= n)
        print(f"{count} twins run after {time.monotonic() - begun:.0f} s")
        time.sleep(5.0)
        before, since = service.twins(), time.monotonic()
        again: list[float] = []
        killed: set[str] = set()
        while (left := since + seconds - time.monotonic()) > 0.0:
            time.sleep(min(left, KILL_PERIOD_S / 2))
            if left > KILL_PERIOD_S:
                name = sorted(before)[::10][len(again) % len(range(0, count, 10))]
                killed.add(name)
                starts, at = service.twins()[name]["starts"], time.monotonic()
                os.kill(service.twins()[name]["pid"], signal.SIGKILL)
                service.wait(lambda twins, n=name, s=starts: twins[n]["starts"] > s and all_run(twins))
                again.append(time.monotonic() - at)
                time.sleep(KILL_PERIOD_S / 2)
        after, took = service.twins(), time.monotonic() - since
        asked = time.perf_counter()
        service.ask("/api/session")
        page = time.perf_counter() - asked
        rest = [name for name in before if name not in killed]
        for name in rest:
            if after[name]["pid"] != before[name]["pid"]:
                wrong.append(f"{name} was started again, but not killed")
            rate = (after[name]["measurements"] - before[name]["measurements"]) / took
            if rate < MIN_SHARE * RATE_HZ * 14 / 15:  # the simulator loses one in 15
                wrong.append(f"{name} measured at {rate:.1f} Hz")
        cpu = np.array([after[name]["cpu"] - before[name]["cpu"] for name in rest]) / took
        memory = np.array([after[name]["memory"] for name in after]) / 1e6
        ticks = sum(map(int, Path(f"/proc/{service.process.pid}/stat").read_text().split()[13:15]))
        own = ticks / (os.sysconf("SC_CLK_TCK") * (time.monotonic() - begun))
        print(f"processor: {100 * np.median(cpu):.1f} % of a core for each twin, the service {100 * own:.1f} %")
        total = f"{memory.sum():.0f} MB in all; overview {page * 1e3:.0f} ms"
        print(f"memory: {np.median(memory):.0f} MB for each twin, {total}")
        print(f"killed {len(again)} times, runs again after {', '.join(f'{seconds:.1f}' for seconds in again)} s")
    finally:
        service.stop()
    return wrong


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--twins", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=5.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wrong = measure(given.twins, 60.0 * given.minutes, Path(folder))
    for line in wrong:
        print(f"wrong: {line}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
