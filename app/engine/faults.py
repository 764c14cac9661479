"""Faults on demand: check a user's request against the model and inject it into the running source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Protocol, runtime_checkable

from estimators.errors import LARGEST, ConfigError, SourceError, nearest, quoted
from estimators.model.state_space import StateSpaceModel
from sources.faults.kinds import KINDS, OLD_NAMES, Fault, find_kind, numbers, problem
from sources.faults.layer import Faults, FaultStatus
from sources.source import Source

from ..result import JsonObject
from . import commands

FAULT_FIELDS = {"end": "duration", "sensor": "target", "input": "target", "parameter": "target"}
"""Fields of a fault with another name in the command."""

SAME_FIELDS = ("row", "other", "size", "rate", "every", "count")
"""Fields of a fault with the same name in the command."""


@runtime_checkable
class Faulty(Protocol):
    """A source behind a layer of faults."""

    faults: Faults


def fault_of(command: commands.InjectFault, model: StateSpaceModel) -> Fault:
    """Return the fault that a command asks for. A target is a sensor, an input or (of kind model) a parameter.

    A name that a sensor and an input share is the sensor; `input.NAME` is the input.

    Raises:
        ConfigError: If the kind or the target is not known, or a number is missing or cannot be.
    """
    if OLD_NAMES.get(command.kind, command.kind) not in KINDS:
        raise ConfigError(f"InjectFault: kind is {quoted(command.kind)}; {nearest(command.kind, list(KINDS))}")
    lasts = inf if command.duration is None else command.duration
    if not (0.0 < lasts <= LARGEST or lasts == inf):
        raise ConfigError(f"InjectFault: duration is {lasts:g} s; it must be positive, and {LARGEST:g} s at most")
    fault = Fault(command.kind, end=lasts, **{name: getattr(command, name) for name in SAME_FIELDS})
    if command.target is not None:
        what, name = _target(command.kind, command.target, model)
        fault = replace(fault, **{what: name})  # type: ignore[arg-type]
    elif "twin" not in find_kind(command.kind).of:
        needs = " or ".join(find_kind(command.kind).of)
        raise ConfigError(f"InjectFault: target is missing; a fault of kind {command.kind} needs the name of a {needs}")
    wrong = problem(fault, model)
    if wrong:
        field, text = wrong
        raise ConfigError(f"InjectFault: {FAULT_FIELDS.get(field, field)} {text}")
    return fault


def _target(kind: str, target: str, model: StateSpaceModel) -> tuple[str, str]:
    """Return the kind of a target (sensor, input or parameter) and its name."""
    known = {
        "sensor": model.sensor_names,
        "input": model.input_names,
        "parameter": tuple(item.name for item in model.parameters),
    }
    takes = [what for what in known if what in find_kind(kind).of]
    what, dot, name = target.partition(".")
    if dot and what in takes:
        return what, name
    for what in takes:
        if target in known[what]:
            return what, target
    names = [name for what in takes for name in known[what]]
    remedy = nearest(target, names) if names else "there is none"
    if "twin" in find_kind(kind).of:
        remedy += "; null is the whole source"
    raise ConfigError(f"InjectFault: target is {quoted(target)}, no {' or '.join(takes)} of {model.name}; {remedy}")


def prepared_fault(
    command: commands.InjectFault | commands.ClearFault, source: Source, model: StateSpaceModel
) -> Callable[[], str]:
    """Check a command, and return what begins a fault, or ends one or all, and gives a line about it.

    Raises:
        ConfigError: If the source cannot do it, with the reason.
    """
    if not isinstance(source, Faulty):
        raise ConfigError("this is the review of a recording; faults can be injected into a running source only")
    layer = source.faults
    if isinstance(command, commands.ClearFault):
        number = command.number
        if number is not None and number not in [item.number for item in layer.status()]:
            raise ConfigError(f"ClearFault: number is {number}; there is no such fault, see faults of the status")
        return lambda: f"{ended} fault(s) end" if (ended := layer.clear(number)) else "no fault to end"
    fault = fault_of(command, model)
    if fault.parameter is not None and not layer.can_change:
        raise ConfigError("InjectFault: kind is model; it needs a simulated asset, and this source is none")

    def inject() -> str:
        try:
            return f"fault {layer.inject(fault)} begins: {fault_text(fault, model)}"
        except SourceError as error:
            raise ConfigError(f"InjectFault: {error}") from None

    return inject


def fault_text(fault: Fault, model: StateSpaceModel) -> str:
    """Describe a fault in a few words: bias of winding, size 2 °C."""
    units: set[str] = set()
    if fault.input is not None:
        units = {item.unit for item in model.inputs if item.name == fault.input}
    elif fault.sensor is not None:
        rows = model.sensors[model.sensor_names.index(fault.sensor)].rows
        units = {row.unit for row in rows if fault.row in (None, row.name)}
    # Values of several units have none in common.
    own = (units.pop() if len(units) == 1 else "") or "units"
    kind = find_kind(fault.kind)
    unit_of = {item.name: item.unit.replace("row", own) for item in kind.parameters}
    parts = [f"{name} {value:g} {unit_of[name]}".removesuffix(" 1") for name, value in numbers(fault).items()]
    with_other = f" and {fault.other}" if fault.other is not None else ""
    return ", ".join([f"{kind.name} of {fault.target}{with_other}", *parts])


def status_json(items: tuple[FaultStatus, ...], model: StateSpaceModel) -> list[JsonObject]:
    """Return the active and planned faults for the API; `since` in ns, null for a planned one."""
    return [
        {
            "number": item.number,
            "kind": find_kind(item.fault.kind).name,
            "target": item.fault.target,
            "text": fault_text(item.fault, model),
            "since": item.since,
            "touched": item.touched,
            "lost": item.lost,
        }
        for item in items
    ]


def catalogue_json(source: Source, model: StateSpaceModel) -> JsonObject:
    """Return the kinds of fault with their parameters and possible targets, for the page."""
    layer = source.faults if isinstance(source, Faulty) else None
    return {
        "available": layer is not None,
        "kinds": [
            vars(kind)
            | {
                "parameters": [
                    {"name": item.name, "unit": item.unit, "help": item.help, "default": item.default}
                    for item in kind.parameters
                ]
            }
            for kind in KINDS.values()
            if kind.name != "model" or (layer is not None and layer.can_change)
        ],
        "sensors": {
            sensor.name: [{"name": row.name, "unit": row.unit} for row in sensor.rows] for sensor in model.sensors
        },
        "inputs": {item.name: item.unit for item in model.inputs},
        "parameters": {item.name: item.unit for item in model.parameters},
    }
