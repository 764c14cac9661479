"""Wear of a cell's resistance and capacity over fifty discharges, each from what the one before left of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import process_time

import numpy as np

from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from estimators.fit.fit import Line
from estimators.fold import Fold
from estimators.log import INPUT, READING, Events, Log
from estimators.tuning import Tuning

from .ways import DUAL, HELD, JOINT, Value, Z, at_end, errors, held, line_of, untold, walked

HALF = "joint, half the drift"
CYCLES = 50
PARAMETERS = ("r0", "capacity")
SPREAD = {"r0": (0.005, 3e-5), "capacity": (0.15, 2e-4)}
"""What joint estimation believes of each: deviation at the start, and drift in √s, which is what a cycle wears of the
capacity, or more."""

WORN = {"r0": 1.5, "capacity": 0.8}
"""What is left of each after the last cycle, as a share of what it was."""


def cycle(number: int, parameters: Sequence[str], drift: float = 1.0) -> tuple[Twin, Log]:
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
    share = number / (CYCLES - 1)
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
    print(f"battery_dmegc, {CYCLES} discharges, one after another: {what}", flush=True)
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {HELD: [], JOINT: [], HALF: [], DUAL: []}
    seconds, inside = dict.fromkeys(found, 0.0), {name: [0, 0] for name in found}
    left: dict[str, Fold] = {}
    tuning: Tuning | None = None
    print(f"  {'cycle':>5}  {'true r0, Ω':>10}{'joint':>28}{'dual':>28}  {'true C, A h':>10}{'joint':>28}{'dual':>28}")
    for number in range(CYCLES):
        single, log = cycle(number, ())
        true = dict.fromkeys(PARAMETERS, np.nan)
        if simulated:
            log, true = worn(single, log, number, np.random.default_rng(number))
        came = held(single, log, PARAMETERS)
        found[HELD].append(errors(single.model.state_names, log, came.track, "soc", 0))
        seconds[HELD] += came.seconds
        values = {}
        for way, drift in ((JOINT, 1.0), (HALF, 0.5)):
            together, _ = cycle(number, PARAMETERS, drift)
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

        for way, told_of in values.items():
            for name, value in told_of.items():
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


def _value(line: Line | None) -> Value:
    """What a window says, adopted or not."""
    return Value(np.nan, np.nan, np.nan) if line is None or line.alone else Value(line.after, line.low, line.high)
