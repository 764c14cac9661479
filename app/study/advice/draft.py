"""A draft as two files: a model of generic motions in Python, and the YAML that feeds it from the recording."""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from config.loader import shipped
from config.yaml_files import writing
from estimators.diagnostics.repeats import SINGLE, UNDECIDED, RepeatFinding
from estimators.errors import ConfigError
from sources.can.readers import BusName
from sources.inspect import RecordingContents
from sources.units import heading_unit

from ...format_time import duration_text
from ...twin.defaults import rhythm
from .plan import OMITTED, YAML_NAME, DraftCheck, DraftPlan, Moves, Reads
from .signals import Signal, comes_by_chance

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
MIN_OFFSET, MAX_OFFSETS = 0.1, 16
"""Step of its values, in σ of its noise, from which the only sensor of a state has an offset of that size, and number
of sensors up to which. Those of several sensors were fitted to each other."""
MAX_NAME = 100
"""Longest name of a twin: a file system takes 255 bytes, with endings and the names of archives."""


@dataclass(frozen=True)
class Draft:
    """Files of a draft, and its plan."""

    yaml_path: Path
    python_path: Path
    plan: DraftPlan

    @property
    def paths(self) -> tuple[Path, Path]:
        """Both files."""
        return self.yaml_path, self.python_path


def write_draft(
    drafted: DraftPlan,
    found: RecordingContents,
    name: str,
    folder: Path,
    databases: Sequence[tuple[Path, BusName]] = (),
) -> Draft:
    """Write NAME.yaml and NAME.py, a twin of a recording's signals that can be run as it stands.

    To propose roles without writing anything, call `plan(found, roles).roles`: one `SignalRole` (signal, role, name,
    reason) for every signal of the recording. To change one, name it in `Roles`.

    Args:
        drafted: The plan (`plan`), fitted (`draft_fit.fit_all`).
        found: Contents of the recording (`sources.inspect.inspect_recordings`).
        name: Letters, digits, _ and -, beginning with a letter.
        folder: An existing folder; the YAML names the recording relative to it where it lies within, else in full.
        databases: DBC files of a CAN log and the bus of each, as given to `inspect_recordings`.

    Raises:
        ConfigError: If the files exist or cannot be written.
    """
    check_new(name, folder)
    model = model_of(name)
    text = yaml_text(name, model, drafted, found, databases, folder)
    return Draft(*write_pair(name, folder, text, python_text(name, model, drafted)), drafted)


def check_new(name: str, folder: Path) -> None:
    """Refuse a twin that could not be written.

    Raises:
        ConfigError: If the name or the folder will not do, or one of the files is there already.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(f"the name {name!r} is not valid; use letters, digits, _ and -, and begin with a letter")
    if len(name) > MAX_NAME:
        raise ConfigError(f"the name of the twin has {len(name)} letters; choose one of at most {MAX_NAME}")
    if name in shipped():
        raise ConfigError(f"the name {name!r} is that of a bundled twin; choose another")
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder; create it first")
    for path in (folder / f"{name}.yaml", folder / f"{name}.py"):
        if path.exists():
            raise ConfigError(f"{path}: already exists and is not overwritten; choose another name")


def model_of(name: str) -> str:
    """The name of the model of a twin: MyPump of my-pump."""
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"[_-]+", name))


def write_pair(name: str, folder: Path, yaml_text: str, python_text: str) -> tuple[Path, Path]:
    """Write the two files of a twin, or none of them.

    Raises:
        ConfigError: If the folder cannot be written to.
    """
    paths = folder / f"{name}.yaml", folder / f"{name}.py"
    begun: list[Path] = []
    try:
        for path, text in zip(paths, (yaml_text, python_text), strict=True):
            with writing(path), path.open("x", encoding="utf-8") as file:
                begun.append(path)
                file.write(text)
    except ConfigError:  # What is left of it would be in the way of the next attempt.
        for path in begun:
            path.unlink()
        raise
    return paths


def _number(value: float) -> str:
    """Three digits, as YAML reads a number (1e-05 without a point would be text)."""
    text = f"{value:.3g}"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if e else text


def rounded(value: float) -> float:
    """Return a value as the draft's YAML has it."""
    return float(f"{value:.3g}")


def _text(value: str) -> str:
    """A text in quotes, for YAML and Python alike; a name from a log may hold line ends."""
    return json.dumps(value, ensure_ascii=False)


def python_text(name: str, model: str, drafted: DraftPlan) -> str:
    """The model's file: a random walk, a constant speed or a first-order lag for each state."""
    states, noises, sensors, steps, functions = [], [], [], [], []
    parameters: list[str] = []
    families = _families(drafted)
    k = 0
    inputs = [each for each, _ in drafted.inputs]
    for item in drafted.states:
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
            family = families.get(reads.name)
            member = f", family={_text(family.name)}" if family else ""
            sensors.append(f"        Sensor({_text(reads.name)}, ({row},), h=read_{reads.name}{member}),")
        k += 2 if item.smooth else 1
    read = "\n\n".join(functions)
    given = [
        f"        Input({_text(each)}, {_text(one.series.unit)}, default={float(one.series.values[0]):.6g}),"
        for each, one in drafted.inputs
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

{uses_math}from nisus import {", ".join(names)}

# Every function is written for ONE state and fills `out`. x: states, u: inputs, p: parameters, in the order below.
# They are compiled, so keep to numbers, math and loops; names outside the function must be constants.


def step(x, u, p, dt, out):
    """The next state, dt seconds later."""
{lines(steps)}


{read}

{model} = StateSpaceModel(
    name={_text(name)},
    title={_text(_title(drafted))},
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


def _title(drafted: DraftPlan) -> str:
    number = len(drafted.signals)
    return f"{number} signal{'s' if number > 1 else ''} of a recording"


def _start(item: Moves) -> float:
    """Where a state begins; an angle within half a turn."""
    first = float(item.signal.series.values[0])
    return (first + math.pi) % (2.0 * math.pi) - math.pi if item.signal.wraps else first


def _speed(item: Moves) -> float:
    """Typical speed of a signal, by its differences; two rows at nearly one time count as an interval apart."""
    series = item.signal.series
    apart = np.diff(series.t) * 1e-9
    usual = float(np.median(apart[apart > 0.0])) if np.any(apart > 0.0) else 1.0
    return max(float(np.std(np.diff(series.values) / np.maximum(apart, usual))), 1e-9)


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
    """Time constant, value without inputs, and gains of a lag."""
    if item.lag is None:
        return []
    unit = item.signal.series.unit
    return [
        f'        Parameter({_text(f"{item.name}_lag")}, "s", {item.lag.tau:.4g}, low={item.lag.tau / 100.0:.3g}),',
        f"        Parameter({_text(f'{item.name}_base')}, {_text(unit)}, {item.lag.offset:.6g}),",
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
    drafted: DraftPlan,
    found: RecordingContents,
    databases: Sequence[tuple[Path, BusName]],
    folder: Path,
) -> str:
    """The twin's YAML, with the recording as its source."""
    noise, sensors, read = [], [], drafted.sensors
    for item in drafted.states:
        unit = item.signal.series.unit or "1"
        over = f", correlation_time: {rounded(item.over):g} s" if item.over else ""
        what = f"({unit})²/s" + ("³, of its speed" if item.smooth else "")
        noise.append(
            f"  {item.second if item.smooth else item.name}: {{variance: {_number(item.q)}{over}}}  # {_line(what)}"
        )
        for reads in item.sensors:
            std, step = math.sqrt(reads.r), reads.signal.resolution
            fields = f"std: {_number(std)}"
            if step > MIN_OFFSET * std and len(item.sensors) == 1 and len(read) <= MAX_OFFSETS:
                fields += f", offset: {{std: {_number(step)}}}"
            if reads.error is not None:
                size, time = _number(rounded(reads.error[0])), rounded(reads.error[1])
                fields += f", error: {{variance: {size}, correlation_time: {time:g} s}}"
            fields += ", use: false" if reads.name in drafted.held_out else ""
            fields += ", expected: by chance" if comes_by_chance(reads.signal, found.t) else ""
            what = "the rate of " if reads.rate else ""
            unit = reads.signal.series.unit or "1"
            sensors.append(f"  {reads.name}: {{{fields}}}  # {_line(unit)}; measures {what}{item.name}")
    source = _source(drafted, found, databases, folder)
    first = next((f"[{item.name}, {item.second}]" for item in drafted.states if item.smooth), None)
    if first is None and len(drafted.states) > 1:
        first = f"[{drafted.states[0].name}, {drafted.states[1].name}]"
    timed = [reads.signal for reads in read if reads.signal.rate > 0.0]
    slowest = max(1.0 / one.rate for one in timed)
    steady = [one for one in timed if not comes_by_chance(one, found.t)]
    longest = max(rhythm(one.series.t) for one in steady or timed)
    degraded, stale = max(3.0, 5.0 * longest), max(15.0, 20.0 * longest)
    at_times = f", at times every {longest:.3g} s" * (longest > 2.0 * slowest)
    text = "\n".join
    return f"""\
# {name}: signals of a recording, each with its own motion. Change it, and {name}.py beside it, into your own twin.
#
# Source: {", ".join(path.name for path in found.files[:3])}{", ..." if len(found.files) > 3 else ""}
{text(_comments(drafted, name))}
# Run it: nisus run {name}.yaml      Score it: nisus fold {name}.yaml      Every key: nisus schema
title: {_text(_title(drafted))}
model: ./{name}.py:{model}       # file beside this one, and the name of the model in it

noise:  # model uncertainty, per second; correlation_time: how long a disturbance lasts
{text(noise)}

sensors:  # std: white noise, at least the resolution; error: noise with memory; use: false holds a sensor out;
  # offset: constant error, part of the bands; give the accuracy of the data sheet (here one step of its values)
{text(sensors)}

{_estimator(drafted, name)}
gate: null                       # null uses every measurement; 0.9999 rejects one good measurement in 10,000

time:                            # the slowest sensor reports every {slowest:.3g} s{at_times}
  degraded_after: {degraded:.3g}
  stale_after: {stale:.3g}
  predict_every: {max(0.5, slowest):.3g}

source:
{text(source)}

view:
  pairs: [{first or ""}]
  window: {max(120.0, 200.0 * slowest):.0f}                    # s that the charts show

# Next: nisus run {name}.yaml
"""


def _source(
    drafted: DraftPlan, found: RecordingContents, databases: Sequence[tuple[Path, BusName]], folder: Path
) -> list[str]:
    """Return the lines of the source: one recording, or a part for each that feeds a sensor or input."""
    read = drafted.sensors
    families = _families(drafted)

    def of(part: RecordingContents, k: int) -> list[str]:
        lines = [f"type: {part.kind}", "files:", *(f"  - {_text(_from(path, folder))}" for path in part.files)]
        if part.kind == "can_log":
            lines += [f"zone: {_text(part.time.zone)}"] if part.time.zone else []
            lines.append("dbc:")
            for path, bus in databases:
                where = "" if bus is None else f", channel: {bus if isinstance(bus, int) else _text(bus)}"
                lines.append(f"  - {{file: {_text(_from(path, folder))}{where}}}")
        else:
            columns = ", ".join(map(_text, part.time.names))
            keys = {"column": f"[{columns}]" if part.time.clock else columns, "unit": part.time.unit}
            keys |= {
                key: _text(value)
                for key in ("format", "zone", "date")
                if (value := getattr(part.time, key)) is not None
            }
            lines.append(f"time: {{{', '.join(f'{key}: {value}' for key, value in keys.items())}}}")
            given = part.dialect._asdict() | ({"heading": "none"} if part.dialect.heading == 0 else {})
            lines += [f"{key}: {_text(value)}" for key, value in given.items() if value]
        channels = [
            _channel(family.name, reads.signal, family) if family else _channel(reads.name, reads.signal)
            for reads in read
            if reads.signal.part == k
            for family in (families.get(reads.name),)
            if not family or family.first == reads.name
        ]
        inputs = [
            _channel(each, one._replace(repeats=RepeatFinding(SINGLE))) for each, one in drafted.inputs if one.part == k
        ]
        if channels:
            lines += ["sensors:", *channels]
        if inputs:
            lines += ["inputs:", *inputs]
        return lines if channels or inputs else []

    if not found.parts:
        return [f"  {line}" for line in of(found, 0)]
    lines = ["  type: merged", "  parts:"]
    for k, part in enumerate(found.parts):
        lines += [f"    {'  ' if n else '- '}{line}" for n, line in enumerate(of(part, k))]
    return lines


class Family(NamedTuple):
    """Sensors that read one column, each the rows of one source: name, column of the sources, and its first sensor.

    `ids` are the names of the sources by those in the names of the sensors, where these differ.
    """

    name: str
    by: str
    first: str
    ids: dict[str, str]


def _families(drafted: DraftPlan) -> dict[str, Family]:
    """Return the family of each sensor that has one."""
    groups: dict[tuple[int, str], list[Reads]] = {}
    for reads in drafted.sensors:
        if reads.signal.series.only is not None:
            groups.setdefault((reads.signal.part, reads.signal.series.column), []).append(reads)
    found: dict[str, Family] = {}
    for members in groups.values():
        name = os.path.commonprefix([reads.name for reads in members]).rpartition("_")[0]
        if len(members) > 1 and name:
            only = [reads.signal.series.only or ("", "") for reads in members]
            ids = {reads.name.removeprefix(f"{name}_"): label for reads, (_, label) in zip(members, only, strict=True)}
            same = all(key == label for key, label in ids.items())
            family = Family(name, only[0][0], members[0].name, {} if same else ids)
            found |= {reads.name: family for reads in members}
    return found


MAX_NAMES = 8  # Signals that a line names
LINE_LENGTH = 112  # of comments in the YAML


def _line(value: str) -> str:
    """Return text of a recording as part of a comment."""
    return " ".join(value.split())


def _estimator(drafted: DraftPlan, name: str) -> str:
    """Return the section of the filter."""
    if not drafted.options:
        return f"estimator: kf                    # nisus filters --twin {name}.yaml lists those that fit"
    options = ", ".join(
        f"{key}: {value if isinstance(value, str) else format(value, 'g')}" for key, value in drafted.options.items()
    )
    why = "# adapt: Q scales the model uncertainty with the activity of the asset"
    return f"estimator: {{name: kf, options: {{{options}}}}}  {why}"


def _comments(drafted: DraftPlan, name: str) -> list[str]:
    """Return the states in words, the check and the omitted signals, as comments."""
    lines = []
    for item in drafted.states:
        if item.lag is not None:
            moves = f"follows {', '.join(item.inputs)} with a time constant of {item.lag.tau:.3g} s"
        else:
            moves = "has a speed that varies" if item.smooth else "is a random walk"
        others = [reads.name for reads in item.sensors[1:]]
        more = f"; also measured by {', '.join(others)}" if others else ""
        lines.append(f"# State {item.name} {moves}{more}.")
    if drafted.check is not None:
        check = drafted.check
        lines += [
            *(f"# {text}" for text in textwrap.wrap(f"{check.fitted_to}:", LINE_LENGTH)),
            f"# {check.words.replace(YAML_NAME, f'{name}.yaml')}.",
            *(f"#   {text}" for text in check_lines(check)),
        ]
    for line in (*hint_lines(drafted), *omission_lines(drafted)):
        lines += [f"# {text}" for text in textwrap.wrap(line, LINE_LENGTH, subsequent_indent="  ")]
    return lines


def hint_lines(drafted: DraftPlan) -> list[str]:
    """Return what the draft does not use of its signals, with the next step, a line each."""
    sensors = [reads.signal for reads in drafted.sensors]
    lines = [
        f"{_line(one.name)}: {one.repeats.reason}"
        + f"; the draft has repeats: {one.repeats.key}" * bool(one.repeats.key)
        for one in sensors
        if one.repeats.found
    ]
    lines += undecided_lines((_line(one.name), one.repeats) for one in sensors)
    for name, one in drafted.inputs:
        if not any(name in item.inputs for item in drafted.states):
            rate = next((pair for pair in drafted.pairs if pair.rate and drafted.signals[pair.second] is one), None)
            if rate is not None:
                state = drafted.signals[rate.first].name
                lines.append(
                    f"Input {name} is the rate of {state} (it explains {rate.explained:.0%} of the changes): write its "
                    " effect into step() (docs/twins.md, Inputs that integrate), or give it with --sensors."
                )
                continue
            lines.append(
                f"Input {name} is not used: no first-order lag behind it explains half of the variance of a state. "
                "Write its effect into step(), or omit it."
            )
    cycles = []
    for item in drafted.states:
        if item.cycle is not None:
            size = f"{item.cycle[1]:.3g} {item.signal.series.unit}".strip()
            cycles.append(f"{item.name} every {duration_text(item.cycle[0])} (amplitude {size})")
    if cycles:
        lines.append(
            f"Cycles that the draft does not know: {', '.join(cycles)}. For forecasts add them to the model: "
            "docs/twins.md, Cycles."
        )
    return lines


def undecided_lines(found: Iterable[tuple[str, RepeatFinding]]) -> list[str]:
    """Return of which signals it cannot be decided whether they repeat values, by the reason, a line each."""
    reasons: dict[str, list[str]] = {}
    for name, one in found:
        if one.kind == UNDECIDED:
            reasons.setdefault(one.reason, []).append(name)
    return [
        f"Whether each row is a measurement cannot be decided ({reason}): {', '.join(names[:MAX_NAMES])}"
        + f" and {len(names) - MAX_NAMES} more" * (len(names) > MAX_NAMES)
        for reason, names in reasons.items()
    ]


def omission_lines(drafted: DraftPlan) -> list[str]:
    """Return the omitted signals by the reason, a line each."""
    reasons: dict[str, list[str]] = {}
    for one in drafted.roles:
        if one.role == OMITTED:
            reasons.setdefault(one.reason, []).append(_line(one.signal.name))
    return [f"Omitted {len(names)} ({reason}): {', '.join(names)}" for reason, names in reasons.items()]


def check_lines(check: DraftCheck) -> list[str]:
    """Return the coverage of each sensor in words."""
    lines = []
    for one in check.sensors:
        if not one.n:
            lines.append(f"{one.name}: no measurement with a prediction in the checked part")
            continue
        held_out = f", {100 * one.held_out.value:.1f} % when held out" if math.isfinite(one.held_out.value) else ""
        lines.append(
            f"{one.name}: {100 * one.coverage.value:.1f} % of {one.n:,} measurements in the 95 % band{held_out}, "
            f"correlation of successive innovations {one.correlation.value:+.2f}"
        )
    return lines


def _channel(name: str, one: Signal, family: Family | None = None) -> str:
    """Return the YAML line with the location of the values of a sensor, an input or a family."""
    column = one.series.column or one.series.name
    fields = {"columns": _text(column)} if one.message is None else {"message": _text(one.message)}
    if one.message is not None:
        fields["signals"] = _text(column)
        if one.series.source is not None:
            fields["source"] = f"{one.series.source:#04x}"
    elif one.unit != one.series.unit and not heading_unit(column):
        fields["units"] = _text(one.unit)
    if one.valid:
        fields["valid_if"] = f"{{{_text(one.valid)}: 1}}"
    if family is not None:
        ids = ", ".join(f"{_text(key)}: {_id(label)}" for key, label in family.ids.items())
        fields["landmark_column"] = f"{{{_text(family.by)}: {{{ids}}}}}" if ids else _text(family.by)
    elif one.series.only is not None:
        by, label = one.series.only
        fields["only"] = f"{{{_text(by)}: {_id(label)}}}"
    if one.repeats.key:
        fields["repeats"] = one.repeats.key
    why = f"  # {one.repeats.reason}" if one.repeats.key else ""
    return f"  {name}: {{{', '.join(f'{key}: {value}' for key, value in fields.items())}}}{why}"


def _id(label: str) -> str:
    """Return the name of a source as YAML: a number as it is, text in quotes."""
    return label if re.fullmatch(r"-?\d+", label) else _text(label)


def _from(path: Path, folder: Path) -> str:
    """A path as the YAML names it: relative where it lies in the same folder, or below."""
    absolute, base = os.path.abspath(path), os.path.abspath(folder)
    inside = os.path.commonpath([absolute, base]) == base
    return os.path.relpath(absolute, base) if inside else absolute
