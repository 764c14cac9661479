"""`python -m tests.benchmarks.dual`: dual estimation beside joint estimation, on recordings whose truth is withheld.

Each recording is folded with a parameter held where the twin starts it, moved into the state (`estimate`, joint), and
fitted window after window by what a running twin with `refit` does (dual; a window's result counts from its end on).
All are scored on the same rows, those after the first window: the state that was withheld, root mean square and share
in the 95 % band; the log density of a reading before it was seen; the parameter at the end with its 95 % interval; and
seconds of the processor.

The last two tables are of wear over cycles: fifty discharges of one cell, each from what the one before left of the
parameters, as recorded (by its counter it did not fade), and with voltages of a cell that is simulated under the same
currents while its resistance grows by half and its capacity shrinks by a fifth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from estimators.log import Log
from estimators.track import USED, Track

from .ways import DUAL, HELD, JOINT, Came, Z, dual, errors, held, joint
from .wear import cycles


class Case(NamedTuple):
    """A recording: the twin of the joint way with its overrides, the truth, the windows, and what is known of them."""

    title: str
    twin: str
    truth: str
    parameters: tuple[str, ...]
    window: float
    every: float
    more: Mapping[str, str]
    note: str


CASES = (
    Case(
        "motor_bench, resistance of the water jacket started 50 % off",
        "motor_bench_joint",
        "magnet",
        ("yoke_coolant",),
        600.0,
        300.0,
        {},
        "fitted with the magnet measured: 0.032 K/W",
    ),
    Case(
        "motor_bench, resistance between tooth and magnet, which no sensor touches, started 50 % off",
        "motor_bench",
        "magnet",
        ("tooth_magnet",),
        600.0,
        300.0,
        {"parameters.tooth_magnet": "1.65", "estimate": "{tooth_magnet: {std: 0.5, drift: 1e-4}}", "view": "{}"},
        "fitted with the magnet measured: 1.1 K/W",
    ),
    Case(
        "battery_panasonic, US06, series resistance as the cell was fitted",
        "battery_panasonic",
        "soc",
        ("r0",),
        1200.0,
        600.0,
        {},
        "fitted with the charge known: 0.0328 Ω",
    ),
    Case(
        "battery_panasonic, US06, series resistance started 50 % off",
        "battery_panasonic",
        "soc",
        ("r0",),
        1200.0,
        600.0,
        {"parameters": "{r0: 0.0492}", "estimate.r0": "{std: 0.02, drift: 3e-5}"},
        "fitted with the charge known: 0.0328 Ω",
    ),
    Case(
        "battery_panasonic, US06, capacity started 20 % off, series resistance in the state both ways",
        "battery_panasonic",
        "soc",
        ("capacity",),
        1800.0,
        900.0,
        {"parameters": "{capacity: 2.32}", "estimate.capacity": "{std: 0.6, drift: 1e-4}"},
        "by the tester's counter: 2.9 A h",
    ),
)


def apart(case: Case) -> Twin:
    """The twin with these parameters held: what else `estimate` names stays in the state."""
    names = load_twin(case.twin, overrides=case.more).config.estimate
    kept = {name: section for name, section in names.items() if name not in case.parameters}
    flow = ", ".join(f"{name}: {{std: {section.std}, drift: {section.drift}}}" for name, section in kept.items())
    more = {key: value for key, value in case.more.items() if not key.startswith("estimate")}
    return load_twin(case.twin, overrides={**more, "estimate": f"{{{flow}}}", "view": "{}"})


def density(track: Track, start: int) -> float:
    """Mean log density of a reading from row `start` on, nats."""
    used = track.verdict[start:] == USED
    return float(np.mean(track.log_likelihood[start:][used]))


def row(name: str, error: np.ndarray, std: np.ndarray, came: Came, start: int) -> str:
    """Of the table."""
    values = ", ".join(f"{key} {value}" for key, value in came.values.items())
    inside = 100 * np.mean(np.abs(error) <= Z * std)
    cost = f"{came.seconds:.2f} s, {came.folds} fold{'s' if came.folds > 1 else ''}"
    told = f"{np.sqrt(np.mean(error**2)):10.4g}{inside:10.0f} %{density(came.track, start):14.4f}"
    return f"  {name:6}{told}   {cost:22}{values}{came.said}"


def show(case: Case) -> None:
    """Fold and print one recording."""
    together, single = load_twin(case.twin, overrides=case.more), apart(case)
    print(f"{case.title}: windows of {case.window:g} s every {case.every:g} s; {case.note}", flush=True)
    print(f"  {'way':6}{case.truth + ' RMSE':>10}{'in band':>12}{'log density':>14}   {'cost':22}parameter at the end")
    ways: dict[str, Callable[[], tuple[Twin, Log, Came]]] = {
        HELD: lambda: _with(single, lambda twin, log: held(twin, log, case.parameters)),
        JOINT: lambda: _with(together, lambda twin, log: joint(twin, log, case.parameters)),
        DUAL: lambda: _with(single, lambda twin, log: dual(twin, log, case.parameters, case.window, case.every)[0]),
    }
    for name, way in ways.items():
        way() if name != DUAL else None  # compiled, before it is timed
        twin, log, came = way()
        start = int(np.searchsorted(log.t[: log.n], log.t[0] + round(case.window * 1e9)))
        print(row(name, *errors(twin.model.state_names, log, came.track, case.truth, start), came, start), flush=True)


def _with(twin: Twin, work: Callable[[Twin, Log], Came]) -> tuple[Twin, Log, Came]:
    log, _ = read_log(twin, None)
    return twin, log, work(twin, log)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="only tables whose title has one of these words")
    names = parser.parse_args().names
    tables: list[tuple[str, Callable[[], None]]] = [(case.title, lambda case=case: show(case)) for case in CASES]  # type: ignore[misc]
    tables += [("cycles recorded", lambda: cycles(False)), ("cycles simulated", lambda: cycles(True))]
    for title, table in tables:
        if not names or any(name in title for name in names):
            table()
            print()


if __name__ == "__main__":
    main()
