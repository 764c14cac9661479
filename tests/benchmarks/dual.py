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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from time import process_time
from typing import NamedTuple

import numpy as np

from app.twin.defaults import bounds_of
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from estimators.fit.dual import WindowFit, walk
from estimators.fit.fit import EntryFit, Fitted
from estimators.fold import Fold
from estimators.log import INPUT, READING, TICK, TRUTH, Events, Log, truth_of
from estimators.track import USED, Track
from estimators.tuning import Tuning

Z = 1.959963984540054
HELD, JOINT, DUAL = "held", "joint", "dual"


class Value(NamedTuple):
    """A parameter and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g}" + (f" ({self.low:.3g} to {self.high:.3g})" if np.isfinite(self.low) else "")


class Came(NamedTuple):
    """What came of one way: its rows, the parameters at the end by name, seconds of the processor, folds, and more."""

    track: Track
    values: dict[str, Value]
    seconds: float
    folds: int
    said: str = ""


def held(twin: Twin, log: Log, parameters: Sequence[str]) -> Came:
    """As the twin starts it."""
    begun = process_time()
    fold = Fold(twin.estimator, twin.model, twin.tuning, log)
    fold.advance()
    values = {name: Value(float(twin.tuning.get(f"p.{name}") or 0.0), np.nan, np.nan) for name in parameters}
    return Came(fold.track, values, process_time() - begun, 1)


def joint(twin: Twin, log: Log, parameters: Sequence[str]) -> Came:
    """As states."""
    begun = process_time()
    fold = Fold(twin.estimator, twin.model, twin.tuning, log)
    fold.advance()
    return Came(fold.track, at_end(fold, parameters), process_time() - begun, 1)


def at_end(fold: Fold, parameters: Sequence[str]) -> dict[str, Value]:
    """The parameters among the states."""
    mean, cov = fold.moments()
    found = {}
    for name in parameters:
        k = fold.model.state_names.index(name)
        reach = Z * float(np.sqrt(cov[k, k]))
        found[name] = Value(float(mean[k]), float(mean[k]) - reach, float(mean[k]) + reach)
    return found


def dual(twin: Twin, log: Log, parameters: Sequence[str], window: float, every: float) -> tuple[Came, list[WindowFit]]:
    """By windows; the rows are those that the filter had at the time."""
    log, begun = untold(log), process_time()
    found = list(walked(twin, twin.tuning, log, parameters, window, every))
    last = found[-1]
    tuning = last.fitted.setting.tuning if last.fitted is not None and last.proposed else last.tuning
    rows = sum(len(refit.lived) for refit in found)
    rest = Fold(twin.estimator, twin.model, tuning, log)
    rest.advance()
    tracks = [refit.lived for refit in found] + [rest.track.select(slice(rows, None))]
    track = Track(*(np.concatenate(columns) for columns in zip(*tracks, strict=True)))
    folds = sum(refit.fitted.folds for refit in found if refit.fitted is not None)
    said = f"; adopted {sum(refit.proposed for refit in found)} of {len(found)} windows"
    return Came(track, told(found, tuning, parameters), process_time() - begun, folds, said), found


def walked(
    twin: Twin, tuning: Tuning, log: Log, parameters: Sequence[str], window: float, every: float
) -> Iterator[WindowFit]:
    """As `nisus tune --windows`."""
    wanted = [f"p.{name}" for name in parameters]
    bounds = bounds_of(twin.config, twin.model)
    return walk(twin.estimator, tuning, log, wanted=wanted, window=window, every=every, bounds=bounds)


def untold(log: Log) -> Log:
    """The same events, with a query in place of each truth: a fit's judge would see it, too."""
    kind = log.kind[: log.n].copy()
    truth = kind == TRUTH
    kind[truth] = TICK
    again = Log.of(log.model, capacity=log.n) if log.model is not None else Log(log.width, log.n)
    value = np.where(truth[:, None], np.nan, log.value[: log.n])
    events = log.events
    again.extend(Events(events.t, events.arrival, kind, np.where(truth, 0, events.channel).astype(np.int32), value))
    return again


def told(found: Sequence[WindowFit], tuning: Tuning, parameters: Sequence[str]) -> dict[str, Value]:
    """What was adopted last of each parameter, with the interval of that window."""
    values = {}
    for name in parameters:
        lines = [line for refit in found if refit.proposed and (line := line_of(refit.fitted, name)) and not line.alone]
        low, high = (lines[-1].low, lines[-1].high) if lines else (np.nan, np.nan)
        values[name] = Value(float(tuning.get(f"p.{name}") or 0.0), low, high)
    return values


def line_of(fitted: Fitted | None, name: str) -> EntryFit | None:
    """Of a parameter."""
    return None if fitted is None else next((line for line in fitted.lines if line.key == f"p.{name}"), None)


def errors(
    model_states: Sequence[str], log: Log, track: Track, truth: str, start: int
) -> tuple[np.ndarray, np.ndarray]:
    """Error and deviation of a state whose truth is told, from row `start` on."""
    k = model_states.index(truth)
    rows, true = truth_of(log.events, k)
    kept = rows >= start
    return true[kept] - track.mean[rows[kept], k], track.std[rows[kept], k]


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


HALF = "joint, half the drift"
N_CYCLES = 50
PARAMETERS = ("r0", "capacity")
SPREAD = {"r0": (0.005, 3e-5), "capacity": (0.15, 2e-4)}
"""What joint estimation believes of each: deviation at the start, and drift in √s, which is what a cycle wears of the
capacity, or more."""

WORN = {"r0": 1.5, "capacity": 0.8}
"""What is left of each after the last cycle, as a share of what it was."""


def one_cycle(number: int, parameters: Sequence[str], drift: float = 1.0) -> tuple[Twin, Log]:
    """One discharge of the cell, from 0 on; `parameters` are moved into the state, with that share of their drift."""
    column = f"rw_data({number + 1})"
    flow = ", ".join(f"{name}: {{std: {SPREAD[name][0]}, drift: {drift * SPREAD[name][1]}}}" for name in parameters)
    twin = load_twin(
        "battery_dmegc",
        overrides={
            "estimate": f"{{{flow}}}",
            "view": "{}",
            "source.time": f"{{column: {column}.t, unit: s}}",
            "source.inputs.current": f"{{columns: {column}.I}}",
            "source.sensors": f"{{voltage: {{columns: {column}.V}}, temperature: {{columns: {column}.T}}}}",
            "source.truth.soc": f"{{columns: {column}.Q, scale: -1.00937e-4, offset: 1}}",
        },
    )
    return twin, read_log(twin, None)[0]


def worn(twin: Twin, log: Log, number: int, rng: np.random.Generator) -> tuple[Log, dict[str, float]]:
    """The same currents through a simulated cell that has worn, with the noises that the twin believes."""
    model, tuning = twin.model, twin.tuning
    share = number / (N_CYCLES - 1)
    true = {name: float(tuning.get(f"p.{name}") or 0.0) * (1 + share * (WORN[name] - 1)) for name in PARAMETERS}
    p = tuning.p.copy()
    for name, true_value in true.items():
        p[[item.name for item in model.parameters].index(name)] = true_value
    x, u = np.array([1.0, 0.0, 25.0]), np.array([item.default for item in model.inputs], float)
    out, clock, events = np.empty(3), int(log.t[0]), []
    scale = np.sqrt(tuning.q)
    for i in range(log.n):
        time, kind, channel = int(log.t[i]), int(log.kind[i]), int(log.channel[i])
        while clock < time:
            dt = min(model.max_step, (time - clock) * 1e-9)
            model.f(x, u, p, dt, out)
            x, clock = out + scale * np.sqrt(dt) * rng.normal(size=3), min(time, clock + round(dt * 1e9))
        value = log.value[i : i + 1].copy()
        if kind == INPUT:
            u = np.where(np.isfinite(value[0, : u.size]), value[0, : u.size], u)
        elif kind == READING:
            model.sensors[channel].h(x, u, p, value[0])
            value[0, 0] += np.sqrt(tuning.r[model.row_start[channel]]) * rng.normal()
        else:
            value[0] = np.nan
            value[0, : x.size] = x
        events.append((time, log.arrival[i], kind, channel, value[0]))
    again = Log.of(model, capacity=log.n)
    columns = [np.array(column) for column in zip(*events, strict=True)]
    t, arrival, kinds, channels = (
        column.astype(kind) for column, kind in zip(columns, (np.int64, np.int64, np.int8, np.int32), strict=False)
    )
    again.extend(Events(t, arrival, kinds, channels, columns[4]))
    return again, true


def carried(twin: Twin, log: Log, before: Fold | None) -> Fold:
    """Fold one cycle: what the one before left of the parameters, their covariance too, is believed of them now."""
    mean, cov = twin.model.prior_mean.copy(), np.diag(twin.model.prior_std**2)
    if before is not None:
        own = [twin.model.state_names.index(name) for name in PARAMETERS]
        left, spread = before.moments()
        mean[own], cov[np.ix_(own, own)] = left[own], spread[np.ix_(own, own)]
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, prior=(mean, cov))
    fold.advance()
    return fold


def cycles(simulated: bool) -> None:
    """Print what each way says of every tenth cycle, and what it was worth over all of them."""
    what = "simulated wear under the recorded currents" if simulated else "as recorded; the counter saw no fade"
    print(f"battery_dmegc, {N_CYCLES} discharges, one after another: {what}", flush=True)
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {HELD: [], JOINT: [], HALF: [], DUAL: []}
    seconds, inside = dict.fromkeys(found, 0.0), {name: [0, 0] for name in found}
    left: dict[str, Fold] = {}
    tuning: Tuning | None = None
    print(f"  {'cycle':>5}  {'true r0, Ω':>10}{'joint':>28}{'dual':>28}  {'true C, A h':>10}{'joint':>28}{'dual':>28}")
    for number in range(N_CYCLES):
        single, log = one_cycle(number, ())
        true = dict.fromkeys(PARAMETERS, np.nan)
        if simulated:
            log, true = worn(single, log, number, np.random.default_rng(number))
        came = held(single, log, PARAMETERS)
        found[HELD].append(errors(single.model.state_names, log, came.track, "soc", 0))
        seconds[HELD] += came.seconds
        values = {}
        for way, drift in ((JOINT, 1.0), (HALF, 0.5)):
            together, _ = one_cycle(number, PARAMETERS, drift)
            same = Log.of(together.model, capacity=log.n)
            same.extend(log.events)
            begun = process_time()
            left[way] = carried(together, same, left.get(way))
            seconds[way] += process_time() - begun
            values[way] = at_end(left[way], PARAMETERS)
            found[way].append(errors(together.model.state_names, same, left[way].track, "soc", 0))

        begun = process_time()
        tuning = single.tuning if tuning is None else replace(tuning, model=single.model)
        (refit,) = walked(single, tuning, untold(log), PARAMETERS, 1e6, 1e6)
        if refit.fitted is not None and refit.proposed:
            tuning = refit.fitted.setting.tuning
        seconds[DUAL] += process_time() - begun
        values[DUAL] = {name: _value(line_of(refit.fitted, name)) for name in PARAMETERS}
        found[DUAL].append(errors(single.model.state_names, log, refit.lived, "soc", 0))

        for way, values_of in values.items():
            for name, value in values_of.items():
                inside[way][0] += bool(value.low <= true[name] <= value.high)
                inside[way][1] += bool(np.isfinite(value.low))
        if number % 10 == 9 or number == 0:
            cells = "".join(
                f"  {true[name]:10.4g}{str(values[JOINT][name]):>28}{str(values[DUAL][name]):>28}"
                for name in PARAMETERS
            )
            print(f"  {number + 1:5}{cells}{'' if refit.proposed else '  not adopted'}", flush=True)
    for way, pairs in found.items():
        error, std = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
        covered = f"; {inside[way][0]} of {inside[way][1]} intervals hold the true parameter" if inside[way][1] else ""
        print(
            f"  {way:22} soc RMSE {np.sqrt(np.mean(error**2)):.4f}, {100 * np.mean(np.abs(error) <= Z * std):.0f} % in "
            f"band, {seconds[way]:.1f} s{covered if simulated else ''}"
        )


def _value(line: EntryFit | None) -> Value:
    """What a window says, adopted or not."""
    return Value(np.nan, np.nan, np.nan) if line is None or line.alone else Value(line.after, line.low, line.high)


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
