"""The channels of a twin: which signals or columns feed which sensor, input or true state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import TYPE_CHECKING, Any

from config.channels import ChannelSection, SignalSection
from config.fields import ConditionSection, bounds, repeat_period
from config.loader import Loaded
from config.source_schema import FaultSection
from config.yaml_files import Key
from estimators.log import INPUT, READING, TRUTH
from estimators.model.state_space import Field, StateSpaceModel

from .checks import check_names

if TYPE_CHECKING:
    from sources.faults.kinds import Fault
    from sources.source import Channel, Condition


def channels(loaded: Loaded, section: Any, key: Key, model: StateSpaceModel) -> list[tuple[Key, Channel]]:
    """Return the channels of a section, each with its key in the YAML.

    Raises:
        ConfigError: With file and line, if a name or a number of rows does not fit the model.
    """
    rows_of = {sensor.name: [(row.name, row.unit) for row in sensor.rows] for sensor in model.sensors}
    inputs_of = {item.name: [(item.name, item.unit)] for item in model.inputs}
    field = model.states if isinstance(model.states, Field) else None
    states_of = {state.name: [(state.name, state.unit)] for state in model.states} if model.grid is None else {}
    found: list[tuple[Key, Channel]] = []
    for group, kind, known, word in (
        ("sensors", READING, rows_of, "sensor"),
        ("inputs", INPUT, inputs_of, "input"),
        ("truth", TRUTH, states_of, "state"),
    ):
        given = dict(getattr(section, group))
        if kind == TRUTH and field is not None and field.name in given:
            read = {name for _, item in found for name in item.signals}
            found += _cells(loaded, (*key, group, field.name), given.pop(field.name), field, read)
        check_names(loaded, (*key, group), given, list(known), word, model)
        index = {name: k for k, name in enumerate(known)}
        for name, item in given.items():
            place = (*key, group, name)
            found.append((place, channel_of(loaded, place, item, kind, index[name], name, known[name])))
    return found


def _cells(loaded: Loaded, key: Key, item: ChannelSection, field: Field, read: set[str]) -> list[tuple[Key, Channel]]:
    """Return the true values of a whole field from one array; the cells among `read` are left out."""
    if isinstance(item, SignalSection) or len(item.names()) != 1:
        raise loaded.error(key, f"is a field of {len(field)} cells; name one array of a table")
    found = []
    for k in range(len(field)):
        state = field[k]
        column = f"{item.names()[0]}[{state.name.partition('[')[2]}"
        if column not in read:
            cell = item.model_copy(update={"columns": (column,)})
            found.append((key, channel_of(loaded, key, cell, TRUTH, k, state.name, [(state.name, state.unit)])))
    return found


def channel_of(
    loaded: Loaded, key: Key, item: ChannelSection, kind: int, index: int, name: str, rows: list[tuple[str, str]]
) -> Channel:
    """Return the channel of one section, `key`, for these names and units of rows.

    Raises:
        ConfigError: With file and line, if a number of rows or a key does not fit.
    """
    from sources.source import Accuracy, Channel

    names = item.names()
    own = item.accuracy
    if own is not None and kind != READING:
        raise loaded.error((*key, "accuracy"), "is for sensors; leave it out")
    if item.repeats != "keep" and kind != READING:
        raise loaded.error((*key, "repeats"), "is for sensors; leave it out")
    word = "signals" if isinstance(item, SignalSection) else "columns"
    if len(names) != len(rows):
        row_names = ", ".join(row for row, _ in rows)
        raise loaded.error((*key, word), f"names {len(names)}; {name} takes {len(rows)}: {row_names}")
    return Channel(
        kind=kind,
        index=index,
        name=name,
        signals=names,
        message=item.message if isinstance(item, SignalSection) else None,
        units=item.units or (),
        model_units=tuple(unit for _, unit in rows),
        scale=item.scale,
        offset=item.offset,
        where=_conditions(item.valid_if),
        only=_conditions(item.only),
        convert=item.convert,
        origin=item.origin,
        accuracy=None if own is None else Accuracy(own.names, own.std is None, own.units or (None,), own.scale),
        repeats=repeat_period(item.repeats),
        source=item.source if isinstance(item, SignalSection) else None,
    )


def _conditions(given: Mapping[str, ConditionSection]) -> tuple[Condition, ...]:
    from sources.source import Condition
    from sources.tables.text import TextMatch

    found = []
    for signal, rule in given.items():
        if rule.text is None:
            found.append(Condition(signal, *bounds(rule.range)))
        else:
            found.append(Condition(TextMatch(signal, rule.text), 1.0, 1.0))
    return tuple(found)


def read_faults(loaded: Loaded, sections: Sequence[FaultSection], key: Key, model: StateSpaceModel) -> list[Fault]:
    """Return the faults of a list of sections.

    Raises:
        ConfigError: With file and line, if one does not fit the model.
    """
    from sources.faults.kinds import Fault, problem

    found = []
    for k, section in enumerate(sections):
        given = section.model_dump()
        fault = Fault(**{**given, "end": inf if section.end is None else section.end})
        wrong = problem(fault, model)
        if wrong:
            field, text = wrong
            raise loaded.error((*key, k, field) if field else (*key, k), text)
        found.append(fault)
    return found
