"""A draft as two files: a model of generic motions in Python, and the YAML that feeds it from the recording."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sources.can.readers import BusName
from sources.inspect import RecordingContents

from .plan import DraftPlan, Moves, Reads
from .signals import Signal


def _number(value: float) -> str:
    """Three digits, as YAML reads a number (1e-05 without a point would be text)."""
    text = f"{value:.3g}"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if e else text


def _text(value: str) -> str:
    """A text in quotes, for YAML and Python alike."""
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def python_text(name: str, model: str, plan: DraftPlan) -> str:
    """The model's file: a random walk, a constant speed or a first-order lag for each state."""
    states, noises, sensors, steps, functions = [], [], [], [], []
    parameters: list[str] = []
    k = 0
    inputs = [each for each, _ in plan.inputs]
    for item in plan.states:
        unit, first = item.signal.series.unit, _start(item)
        turns = ", circular=True" if item.signal.wraps else ""
        spread = max(float(np.std(item.signal.series.values)), 3 * math.sqrt(item.sensors[0].r))
        states.append(f"        State({_text(item.name)}, {_text(unit)}, mean={first:.6g}, std={spread:.3g}{turns}),")
        if item.smooth:
            rate = item.second
            states.append(
                f"        State({_text(rate)}, {_text(f'({unit or 1})/s')}, mean=0.0, std={_speed(item):.3g}),"
            )
            noises.append(f"        Noise({_text(rate)}, {_text(f'({unit or 1})²/s³')}, variance={item.q:.3g}),")
        else:
            noises.append(f"        Noise({_text(item.name)}, {_text(f'({unit or 1})²/s')}, variance={item.q:.3g}),")
        steps += _moving(item, k, inputs, len(parameters))
        parameters += _parameters(item)
        for reads in item.sensors:
            functions.append(_function(reads, k + 1 if reads.rate else k))
            circular = "" if reads.rate else turns
            unit = _text(reads.signal.series.unit)
            row = f"Row({_text(reads.name)}, {unit}, variance={reads.r:.3g}{circular})"
            sensors.append(f"        Sensor({_text(reads.name)}, ({row},), h=read_{reads.name}),")
        k += 2 if item.smooth else 1
    read = "\n\n".join(functions)
    given = [
        f"        Input({_text(each)}, {_text(one.series.unit)}, default={float(one.series.values[0]):.6g}),"
        for each, one in plan.inputs
    ]
    lines = "\n".join
    more = "".join(
        f"    {word}=(\n{lines(items)}\n    ),\n"
        for word, items in (("inputs", given), ("parameters", parameters))
        if items
    )
    names = sorted(
        ["Noise", "Row", "Sensor", "State", "StateSpaceModel"]
        + ["Input"] * bool(given)
        + ["Parameter"] * bool(parameters)
    )
    uses_math = "import math\n\n" if parameters else ""
    return f'''"""Signals of a recording, each with its own motion: a start for equations that couple them."""

{uses_math}from estimators.model import {", ".join(names)}

# Every function is written for ONE state and fills `out`. x: states, u: inputs, p: parameters, in the order below.
# They are compiled, so keep to numbers, math and loops; names outside the function must be constants.


def step(x, u, p, dt, out):
    """The next state, dt seconds later."""
{lines(steps)}


{read}

{model} = StateSpaceModel(
    name={_text(name)},
    title={_text(_title(plan))},
    states=(
{lines(states)}
    ),
{more}    noises=(
{lines(noises)}
    ),
    sensors=(
{lines(sensors)}
    ),
    f=step,
    linear=True,  # as long as f and h above are
)
'''


def _title(plan: DraftPlan) -> str:
    number = len(plan.signals)
    return f"{number} signal{'s' if number > 1 else ''} of a recording"


def _start(item: Moves) -> float:
    """Where a state begins; an angle within half a turn."""
    first = float(item.signal.series.values[0])
    return (first + math.pi) % (2.0 * math.pi) - math.pi if item.signal.wraps else first


def _speed(item: Moves) -> float:
    """Typical speed of a signal, by its differences."""
    series = item.signal.series
    return max(float(np.std(np.diff(series.values) / np.maximum(np.diff(series.t) * 1e-9, 1e-9))), 1e-9)


def _moving(item: Moves, k: int, inputs: Sequence[str], first: int) -> list[str]:
    """The steps of a state that walks, has a speed, or follows inputs; its parameters begin at p[first]."""
    more = f" + dt * x[{k + 1}]" if item.smooth else ""
    last = [f"    out[{k + 1}] = x[{k + 1}]  # {item.second}"] if item.smooth else []
    if item.lag is None:
        return [f"    out[{k}] = x[{k}]{more}  # {item.name}", *last]
    sums = "".join(f" + p[{first + 2 + j}] * u[{inputs.index(each)}]" for j, each in enumerate(item.inputs))
    return [
        f"    # {item.name} follows {', '.join(item.inputs)} through a first-order lag",
        f"    a = math.exp(-dt / p[{first}])",
        f"    out[{k}] = a * x[{k}] + (1.0 - a) * (p[{first + 1}]{sums}){more}",
        *last,
    ]


def _parameters(item: Moves) -> list[str]:
    """Time constant, offset and gains of a lag."""
    if item.lag is None:
        return []
    unit = item.signal.series.unit
    return [
        f'        Parameter({_text(f"{item.name}_lag")}, "s", {item.lag.tau:.4g}, low={item.lag.tau / 100.0:.3g}),',
        f"        Parameter({_text(f'{item.name}_offset')}, {_text(unit)}, {item.lag.offset:.6g}),",
        *(
            f'        Parameter({_text(f"{item.name}_per_{each}")}, "", {gain:.6g}),'
            for each, gain in zip(item.inputs, item.lag.gains, strict=True)
        ),
    ]


def _function(reads: Reads, k: int) -> str:
    """Return the measurement function of a sensor of state k."""
    text = f"x[{k}]" if reads.gain == 1.0 else f"{reads.gain:.6g} * x[{k}]"
    text += f" + {reads.offset:.6g}" if reads.offset else ""
    return f'def read_{reads.name}(x, u, p, out):\n    """Measurement of {reads.name}."""\n    out[0] = {text}\n'


def yaml_text(
    name: str,
    model: str,
    plan: DraftPlan,
    found: RecordingContents,
    databases: Sequence[tuple[Path, BusName]],
    folder: Path,
) -> str:
    """The twin's YAML, with the recording as its source."""
    files = [_text(_from(path, folder)) for path in found.files]
    noise = [f"  {item.second if item.smooth else item.name}: {{variance: {_number(item.q)}}}" for item in plan.states]
    read = [reads for item in plan.states for reads in item.sensors]
    sensors = [f"  {reads.name}: {{std: {_number(math.sqrt(reads.r))}}}" for reads in read]
    source = [f"  type: {found.kind}", "  files:", *(f"    - {file}" for file in files)]
    if found.kind == "can_log":
        source.append("  dbc:")
        for path, bus in databases:
            where = "" if bus is None else f", channel: {bus if isinstance(bus, int) else _text(bus)}"
            source.append(f"    - {{file: {_text(_from(path, folder))}{where}}}")
    else:
        keys = {"column": _text(found.time.name), "unit": found.time.unit}
        keys |= {key: _text(value) for key in ("format", "zone") if (value := getattr(found.time, key)) is not None}
        source.append(f"  time: {{{', '.join(f'{key}: {value}' for key, value in keys.items())}}}")
    source += ["  sensors:", *(_channel(reads.name, reads.signal) for reads in read)]
    if plan.inputs:
        source += ["  inputs:", *(_channel(each, one) for each, one in plan.inputs)]
    first = next((f"[{item.name}, {item.second}]" for item in plan.states if item.smooth), None)
    if first is None and len(plan.states) > 1:
        first = f"[{plan.states[0].name}, {plan.states[1].name}]"
    slowest = max(1.0 / reads.signal.rate for reads in read if reads.signal.rate > 0.0)
    degraded, stale = max(3.0, 5.0 * slowest), max(15.0, 20.0 * slowest)
    text = "\n".join
    return f"""\
# {name}: signals of a recording, each with its own motion. Change it, and {name}.py beside it, into your own twin.
#
# Source: {", ".join(path.name for path in found.files[:3])}{", ..." if len(found.files) > 3 else ""}
# Expect: a start. The noise below was taken from the differences of the data, and is an average
# where a signal rests and moves; nisus tune fits it, nisus advise checks it.
# Run it: nisus run {name}.yaml      Score it: nisus fold {name}.yaml      Every key: nisus schema
title: {_text(_title(plan))}
model: ./{name}.py:{model}       # file beside this one, and the name of the model in it

noise:                           # model uncertainty, per second
{text(noise)}

sensors:                         # sensor noise
{text(sensors)}

estimator: kf                    # nisus filters --twin {name}.yaml lists those that fit
gate: null                       # null uses every measurement; 0.9999 rejects one good measurement in 10,000

time:                            # the slowest sensor reports every {slowest:.3g} s
  degraded_after: {degraded:.3g}
  stale_after: {stale:.3g}
  tick: {max(0.5, slowest):.3g}

source:
{text(source)}

view:
  pairs: [{first or ""}]
  window: {max(120.0, 200.0 * slowest):.0f}                    # s that the charts show
"""


def _channel(name: str, one: Signal) -> str:
    """Where the values of a sensor or input are found."""
    signal = _text(one.series.name)
    if one.message is None:
        return f"    {name}: {{columns: {signal}}}"
    return f"    {name}: {{message: {_text(one.message)}, signals: {signal}}}"


def _from(path: Path, folder: Path) -> str:
    """A path as the YAML names it: relative where it lies in the same folder, or below."""
    absolute, base = os.path.abspath(path), os.path.abspath(folder)
    inside = os.path.commonpath([absolute, base]) == base
    return os.path.relpath(absolute, base) if inside else absolute
