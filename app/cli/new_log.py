"""`nisus new NAME --log FILE`: a twin of the signals that a recording holds, with noise taken from the data."""

from __future__ import annotations

import keyword
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimators.errors import ConfigError, nearest
from sources.can.frames import BusName
from sources.survey import Series, Survey

MOST = 6
"""Signals that are taken where none are named."""

FEWEST = 20
"""Values needed to estimate a noise."""

_SKIPPED = re.compile(r"time|epoch|date|count|check|crc|valid|status|mode|error|alive|_id$|^id$|parity", re.IGNORECASE)
"""Names of what is no measurement."""


@dataclass(frozen=True)
class Chosen:
    """One signal that becomes a state and a sensor.

    `smooth` says that it moves with a speed of its own, which is a second state. `q` is the variance that the noise
    adds in one second, to the speed if there is one, and `r` that of a reading.
    """

    name: str
    message: str | None
    series: Series
    smooth: bool
    q: float
    r: float


def noise_of(series: Series) -> tuple[bool, float, float]:
    """Whether a signal moves smoothly, its process noise in one second, and the variance of its readings.

    Of a random walk with noisy readings, y = x + v, the differences d have E d² = q dt + 2 r and E d_k d_(k+1) = -r. Of
    one whose speed is a random walk, the second differences e have E e² = ⅔ q dt³ + 6 r and
    E e_k e_(k+1) = q dt³/6 - 4 r. It moves smoothly if its differences follow one another, with a correlation above ½,
    which noise alone makes negative. A variance r is at least that of the resolution, step²/12.

    Source: the covariances of the differences, from the definitions; e is the integral of the noise of the speed
    with a triangle of width 2 dt and height dt.
    """
    y, t = series.values, series.t * 1e-9
    dt = float(np.median(np.diff(t)[np.diff(t) > 0])) if np.any(np.diff(t) > 0) else 1.0
    steady = np.flatnonzero(np.abs(np.diff(t) - dt) < 0.5 * dt)
    d = np.diff(y)
    apart = np.diff(np.unique(y))
    floor = max(float(apart.min()) ** 2 / 12, 1e-12 * float(np.mean(d**2))) if apart.size else 1e-12
    both = steady[:-1][np.diff(steady) == 1] if steady.size > 1 else steady[:0]
    power = float(np.mean(d[steady] ** 2)) if steady.size else float(np.mean(d**2))
    follow = float(np.mean(d[both] * d[both + 1])) if both.size else 0.0
    power = max(power, floor)
    if follow <= 0.5 * power:
        r = max(min(-follow, 0.5 * power), floor)
        return False, max(power - 2 * r, 0.01 * power) / dt, r
    e = d[both + 1] - d[both]
    second = max(float(np.mean(e**2)), floor)
    next_to = np.flatnonzero(np.diff(both) == 1)
    lagged = float(np.mean(e[next_to] * e[next_to + 1])) if next_to.size else 0.0
    r = max(min((second / 4 - lagged) / 5.5, second / 6), floor)
    return True, max(second - 6 * r, 0.01 * second) / (2 / 3 * dt**3), r


def choose(found: Survey, wanted: Sequence[str]) -> list[Chosen]:
    """The signals that become sensors: those that are named, or those that vary most finely.

    Raises:
        ConfigError: If one is not there, is named by several messages, or has too few values.
    """
    offers: list[tuple[str | None, Series]] = [
        (message.name, series) for message in found.messages for series in message.signals
    ]
    offers += [(None, series) for series in found.columns]
    if not offers:
        raise ConfigError(f"{found.files[0]}: no message of it is in a DBC; give one that describes it with --dbc")
    if wanted:
        picked = [_named(name, offers) for name in wanted]
    else:
        fine = [
            (np.unique(series.values).size, -k, item)
            for k, item in enumerate(offers)
            for series in (item[1],)
            if series.values.size >= FEWEST and not _SKIPPED.search(series.name)
        ]
        picked = [item for levels, _, item in sorted(fine, key=lambda entry: entry[:2], reverse=True) if levels > 2]
        picked = [item for item in offers if any(item is other for other in picked[:MOST])]
        if not picked:
            raise ConfigError(f"{found.files[0]}: no signal of it varies; name those to take with --signals")
    names: set[str] = set()
    chosen = []
    for message, series in picked:
        if series.values.size < FEWEST:
            raise ConfigError(
                f"--signals {series.name}: has {series.values.size} values; its noise can be estimated from {FEWEST} on"
            )
        smooth, q, r = noise_of(series)
        chosen.append(Chosen(_identifier(series.name, names), message, series, smooth, q, r))
    return chosen


def _named(name: str, offers: list[tuple[str | None, Series]]) -> tuple[str | None, Series]:
    """SIGNAL or MESSAGE.SIGNAL, or a column."""
    fits = [item for item in offers if name in (item[1].name, f"{item[0]}.{item[1].name}")]
    if not fits:
        raise ConfigError(f"--signals {name}: is not in the log; {nearest(name, [item[1].name for item in offers])}")
    if len({item[0] for item in fits}) > 1:
        several = " or ".join(f"{item[0]}.{item[1].name}" for item in fits)
        raise ConfigError(f"--signals {name}: is in several messages; write {several}")
    return fits[0]


def _identifier(name: str, taken: set[str]) -> str:
    """A name for Python and YAML, of its own."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "value"
    if text[0].isdigit() or keyword.iskeyword(text) or text in ("on", "off", "yes", "no", "null", "true", "false"):
        text = f"s_{text}"
    base, k = text, 2
    while text in taken or f"{text}_rate" in taken:
        text, k = f"{base}_{k}", k + 1
    taken |= {text, f"{text}_rate"}
    return text


def _number(value: float) -> str:
    """Three digits, as YAML reads a number (1e-05 without a point would be text)."""
    text = f"{value:.3g}"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if e else text


def _text(value: str) -> str:
    """A text in quotes, for YAML and Python alike."""
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def python_text(name: str, model: str, chosen: Sequence[Chosen]) -> str:
    """The model's file: a random walk for each signal, or one of its speed."""
    states, noises, sensors, steps, functions = [], [], [], [], []
    k = 0
    for item in chosen:
        unit = item.series.unit
        spread = max(float(np.std(item.series.values)), 3 * math.sqrt(item.r))
        first = float(item.series.values[0])
        states.append(f"        State({_text(item.name)}, {_text(unit)}, mean={first:.6g}, std={spread:.3g}),")
        if item.smooth:
            speed = max(
                float(np.std(np.diff(item.series.values) / np.maximum(np.diff(item.series.t) * 1e-9, 1e-9))), 1e-9
            )
            rate = f"{item.name}_rate"
            states.append(f"        State({_text(rate)}, {_text(f'({unit or 1})/s')}, mean=0.0, std={speed:.3g}),")
            noises.append(f"        Noise({_text(rate)}, {_text(f'({unit or 1})²/s³')}, variance={item.q:.3g}),")
            steps += [f"    out[{k}] = x[{k}] + dt * x[{k + 1}]", f"    out[{k + 1}] = x[{k + 1}]  # {rate}"]
        else:
            noises.append(f"        Noise({_text(item.name)}, {_text(f'({unit or 1})²/s')}, variance={item.q:.3g}),")
            steps.append(f"    out[{k}] = x[{k}]  # {item.name}")
        functions.append(
            f'def read_{item.name}(x, u, p, out):\n    """What the sensor {item.name} reads."""\n    out[0] = x[{k}]\n'
        )
        row = f"Row({_text(item.name)}, {_text(unit)}, variance={item.r:.3g})"
        sensors.append(f"        Sensor({_text(item.name)}, ({row},), h=read_{item.name}),")
        k += 2 if item.smooth else 1
    read = "\n\n".join(functions)
    lines = "\n".join
    return f'''"""Signals of a recording, each as it moves by itself: a start for equations that tie them together."""

from estimators.model import Noise, Row, Sensor, State, StateSpaceModel

# Every function is written for ONE state and fills `out`. x: states, u: inputs, p: parameters, in the order below.
# They are compiled, so keep to numbers, math and loops; names outside the function must be constants.


def step(x, u, p, dt, out):
    """The next state, dt seconds later."""
{lines(steps)}


{read}

{model} = StateSpaceModel(
    name={_text(name)},
    title={_text(f"{len(chosen)} signals of a recording")},
    states=(
{lines(states)}
    ),
    noises=(
{lines(noises)}
    ),
    sensors=(
{lines(sensors)}
    ),
    f=step,
    linear=True,  # as long as f and h above are
)
'''


def yaml_text(
    name: str,
    model: str,
    chosen: Sequence[Chosen],
    found: Survey,
    databases: Sequence[tuple[Path, BusName]],
    unit: str,
    folder: Path,
) -> str:
    """The twin's YAML, with the recording as its source."""
    files = [_text(_from(path, folder)) for path in found.files]
    noise = [f"  {item.name}{'_rate' if item.smooth else ''}: {{variance: {_number(item.q)}}}" for item in chosen]
    sensors = [f"  {item.name}: {{std: {_number(math.sqrt(item.r))}}}" for item in chosen]
    source = [f"  type: {found.kind}", "  files:", *(f"    - {file}" for file in files)]
    if found.kind == "can_log":
        source.append("  dbc:")
        for path, bus in databases:
            where = "" if bus is None else f", channel: {bus if isinstance(bus, int) else _text(bus)}"
            source.append(f"    - {{file: {_text(_from(path, folder))}{where}}}")
    else:
        source.append(f"  time: {{column: {_text(found.time)}, unit: {unit}}}")
    source.append("  sensors:")
    for item in chosen:
        signal = _text(item.series.name)
        if item.message is None:
            source.append(f"    {item.name}: {{columns: {signal}}}")
        else:
            source.append(f"    {item.name}: {{message: {_text(item.message)}, signals: {signal}}}")
    first = next((f"[{item.name}, {item.name}_rate]" for item in chosen if item.smooth), None)
    if first is None and len(chosen) > 1:
        first = f"[{chosen[0].name}, {chosen[1].name}]"
    text = "\n".join
    return f"""\
# {name}: signals of a recording, each as it moves by itself. Change it, and {name}.py beside it, into your own twin.
#
# Source: {", ".join(path.name for path in found.files[:3])}{", ..." if len(found.files) > 3 else ""}
# Expect: a start. The noise below was taken from the differences of the data, and is that of no moment in particular
# where a signal now rests and now moves; what one signal says of another is not in the model yet.
# Run it: nisus run {name}.yaml      Score it: nisus fold {name}.yaml      Every key: nisus schema
title: {_text(f"{len(chosen)} signals of a recording")}
model: ./{name}.py:{model}       # file beside this one, and the name of the model in it

noise:                           # how much the model is distrusted: what it adds in one second
{text(noise)}

sensors:                         # how much each sensor is distrusted
{text(sensors)}

estimator: kf                    # nisus filters --twin {name}.yaml lists those that fit
gate: null                       # uses every reading; 0.9999 refuses those that fewer than one in 10,000 good ones are

source:
{text(source)}

view:
  pairs: [{first or ""}]
  window: 120                    # s that the charts show
"""


def _from(path: Path, folder: Path) -> str:
    """A path as the YAML names it: relative where it lies in the same folder, or below."""
    absolute, base = os.path.abspath(path), os.path.abspath(folder)
    inside = os.path.commonpath([absolute, base]) == base
    return os.path.relpath(absolute, base) if inside else absolute
