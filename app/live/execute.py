"""Carries out what a user asks of the twin, on the engine's thread, between two events."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from estimators.errors import ConfigError, nearest, quoted
from estimators.estimator import Estimator
from estimators.events.maintenance import maintained
from estimators.fold_checks import check_variances
from estimators.log import RESET, Events
from estimators.registry import checked, find_estimator

from ..intake import maintenance_text
from . import commands
from .faults import carry_out
from .interface import Running
from .maintenance import check_maintenance
from .playback import PLAYBACK, play

if TYPE_CHECKING:
    from estimators.tuning import Tuning

    from ..twin.twin import Twin


Refolding = (
    commands.SetEstimator | commands.SetTuning | commands.SetTunings | commands.SetOption | commands.UseSensor
    | commands.Restore | commands.Load
)  # fmt: skip
"""Commands that fold the history again."""


OPTION = "options."
"""Before an option's name among the keys of `SetTunings`."""


def retuned(command: Refolding, engine: Running) -> tuple[str, Tuning]:
    """The estimator and the tuning that a command asks for.

    Raises:
        NisusError: If the engine would refuse them, with the reason.
    """
    if isinstance(command, commands.Restore):
        return engine.twin.estimator, engine.twin.tuning
    if isinstance(command, commands.Load):
        run = engine.revisions.find(command.number)
        return run.estimator, run.tuning
    estimator, tuning = engine.estimator, engine.tuning
    if isinstance(command, commands.SetEstimator):
        entry = find_estimator(command.name, engine.model)
        options = {**engine.options_of(entry.name), **(command.options or {})}
        _check(entry, engine, options)
        return entry.name, tuning.with_options(options)
    if isinstance(command, commands.SetOption):
        return estimator, _with_options(estimator, tuning, {command.name: command.value}, engine)
    if isinstance(command, commands.UseSensor):
        names = engine.model.sensor_names
        if command.name not in names:
            near = nearest(command.name, names)
            raise ConfigError(f"UseSensor: name is {quoted(command.name)}, no sensor of {engine.model.name}; {near}")
        return estimator, tuning.set(f"use.{command.name}", command.used)
    values = command.values if isinstance(command, commands.SetTunings) else {command.key: command.value}
    if not values:
        raise ConfigError("SetTunings: values is empty; it takes the value of each key")
    given: dict[str, Any] = {key.removeprefix(OPTION): value for key, value in values.items() if key.startswith(OPTION)}
    if given and isinstance(command, commands.SetTuning):
        raise ConfigError(f"{command.key} is an option of the estimator; turn it with SetOption")
    for key, value in values.items():
        if not key.startswith(OPTION):
            tuning = tuning.set(key, value)
    return estimator, _with_options(estimator, tuning, given, engine) if given else tuning


def _with_options(estimator: str, tuning: Tuning, given: Mapping[str, Any], engine: Running) -> Tuning:
    entry = find_estimator(estimator, engine.model)
    known = entry.complete(given)
    options = {**tuning.options, **{name: known[name] for name in given}}
    _check(entry, engine, options)
    return tuning.with_options(options)


def _check(entry: Estimator, engine: Running, options: Mapping[str, float]) -> None:
    """Refuse what a fold would refuse, also of readings that are still to come."""
    values = checked(entry, engine.model, options)
    if engine.twin.plan.brings_variances or engine.twin.late.inflate:
        check_variances(entry, values)


def execute(command: commands.Command, engine: Running) -> None:
    """Carry one command out.

    Raises:
        NisusError: If it cannot be done, with the reason; nothing is changed then.
    """
    if isinstance(command, Refolding):
        engine.retune(*retuned(command, engine))
    elif isinstance(command, commands.Pin):
        engine.revisions.pin(command.number)
    elif isinstance(command, commands.Unpin):
        engine.revisions.unpin(command.number)
    elif isinstance(command, commands.Note):
        engine.revisions.describe(command.number, command.name, command.note)
    elif isinstance(command, commands.Reset):
        engine.insert(_reset_now(engine))
        engine.notices.say("estimate reset to the prior")
    elif isinstance(command, commands.Maintenance):
        states = check_maintenance(command.what, command.states, engine.model)
        engine.insert(maintained(_now(engine), time.time_ns(), states, engine.model.width))
        engine.notices.say(maintenance_text(command.what, states, engine.model))
    elif isinstance(command, commands.Record):
        if engine.recorder is None:
            raise ConfigError("this session cannot record")
        engine.recorder.record(command.path)
    elif isinstance(command, commands.InjectFault | commands.ClearFault):
        engine.notices.say(carry_out(command, engine.source, engine.model))
    elif isinstance(command, PLAYBACK):
        play(engine.source, command, engine.span()[0])


def _reset_now(engine: Running) -> Events:
    """A reset now: an event of the log, so that refolds and recordings have it where it was."""
    return Events.one(_now(engine), time.time_ns(), RESET, 0, [], engine.model.width)


def _now(engine: Running) -> int:
    """The time of the last event, ns."""
    now = engine.span()[1]
    if not now:
        raise ConfigError("nothing to reset: no reading has come yet")
    return now


class Remembered:
    """The options with which each filter was left, for when it is chosen again; at first those of the YAML."""

    def __init__(self, twin: Twin) -> None:
        self._twin = twin
        self._left: dict[str, Mapping[str, float]] = {}

    def begin(self, twin: Twin) -> None:
        """The YAML was saved: what it says of a filter's options counts again."""
        self._twin, self._left = twin, {}

    def leave(self, estimator: str, tuning: Tuning) -> None:
        """The filter ran with this tuning."""
        self._left[estimator] = tuning.options

    def of(self, estimator: str) -> Mapping[str, float]:
        """What a filter starts with."""
        return self._left.get(estimator, self._twin.options_of(estimator))
