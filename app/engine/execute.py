"""Check the commands of users, and carry them out on the engine's thread, between two events."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from estimators.errors import ConfigError, nearest, printable, quoted
from estimators.estimator import Estimator
from estimators.events.maintenance import maintained
from estimators.fold_checks import check_variances
from estimators.log import RESET, Events
from estimators.model.state_space import StateSpaceModel
from estimators.registry import checked, find_estimator
from estimators.tuning import Tuning
from sources.source import Source, controls_of, span_of

from ..format_time import duration_text
from ..twin.ingest import maintenance_text
from . import commands
from .copies import AlertMute
from .faults import prepared_fault
from .running_fold import Running

REFOLDING = (
    commands.SetEstimator | commands.SetTuning | commands.SetTunings | commands.SetOption | commands.UseSensor
    | commands.Restore | commands.Load
)  # fmt: skip
"""Commands that fold the history again."""

PLAYBACK = (commands.Pause, commands.Speed, commands.Step, commands.Seek)
"""Commands that only a paced source can carry out."""

OPTION_PREFIX = "options."
"""Prefix of an option's name among the keys of `SetTunings`."""

MAX_MAINTENANCE_TEXT = 200
"""Characters that describe a maintenance."""

MAX_MUTE_S = 30 * 86400.0
"""Longest time in which no alerts are sent."""

MAX_GESTURE_LENGTH = 64

MAX_SEEK_S = 1e9
"""32 years; times are int64 nanoseconds."""

MAX_SPEED = 1e9
"""Times real time. Anything faster is infinity: as fast as possible."""


def execute(command: commands.Command, engine: Running) -> None:
    """Carry one command out; raises as `prepared`, with nothing changed."""
    prepared(command, engine)()


def prepared(command: commands.Command, engine: Running) -> Callable[[], object]:
    """Check a command, in any thread, and return what carries it out on the engine's thread.

    Raises:
        NisusError: If it cannot be done, with the reason.
    """
    runs, model, (first, now) = engine.revisions, engine.model, engine.span()
    if isinstance(command, REFOLDING):
        gesture = getattr(command, "gesture", "")
        if len(gesture) > MAX_GESTURE_LENGTH:
            raise ConfigError(f"gesture has {len(gesture)} characters; it may have {MAX_GESTURE_LENGTH}")
        return partial(engine.edit, *retuned(command, engine), gesture)
    if isinstance(command, commands.Undo | commands.Redo):
        again = isinstance(command, commands.Redo)
        runs.edits.next(again=again)
        return lambda: engine.retune(*runs.edits.step(again=again))
    if isinstance(command, commands.InjectFault | commands.ClearFault):
        act = prepared_fault(command, engine.source, model)
        return lambda: engine.notices.say(act())
    if isinstance(command, PLAYBACK):
        return playback(engine.source, command, first)

    def insert(event: Events, text: str) -> None:
        # An event of the log, so that refolds and recordings have it at its time.
        engine.insert(event)
        engine.notices.say(text)

    match command:
        case commands.Pin(number):
            runs.free_place(number)
            return partial(runs.pin, number)
        case commands.Unpin(number):
            runs.find(number)
            return partial(runs.unpin, number)
        case commands.Note(number, name, note):
            runs.check_words(number, name, note)
            return partial(runs.describe, number, name, note)
        case commands.Annotate(text, at, number):
            if not now:
                raise ConfigError("Annotate: no measurement has arrived yet; wait for the first")
            engine.annotations.check(text, at, number, span_of(engine.source) or (first, now))
            t = None if at is None else round(at * 1e9)
            return partial(engine.annotations.add_or_change, text, t, number, now)
        case commands.DeleteAnnotation(number):
            engine.annotations.find(number)
            return partial(engine.annotations.delete, number)
        case commands.Reset():
            if not now:
                raise ConfigError("Reset: nothing to reset; no measurement has arrived yet")
            event = Events.one(now, time.time_ns(), RESET, 0, [], model.width)
            return partial(insert, event, "estimate reset to the prior")
        case commands.Maintenance(what, names):
            states = maintained_states(what, names, model)
            if not now:
                raise ConfigError("Maintenance: no measurement has arrived yet; the estimate is still the prior")
            event = maintained(now, time.time_ns(), states, model.width)
            return partial(insert, event, maintenance_text(what, states, model))
        case commands.MuteAlerts(seconds, reason):
            if not 0.0 <= seconds <= MAX_MUTE_S:
                raise ConfigError(f"MuteAlerts: seconds is {seconds:g}; it must be from 0 to {MAX_MUTE_S:.0f}, 30 days")
            if len(reason) > MAX_MAINTENANCE_TEXT:
                text = f"has {len(reason)} characters; it may have {MAX_MAINTENANCE_TEXT}"
                raise ConfigError(f"MuteAlerts: reason {text}")
            return partial(_mute, engine, seconds, printable(reason))
        case commands.Record(path):
            if engine.recorder is None:
                raise ConfigError("Record: this session cannot record")
            return partial(engine.recorder.record, path)


def _mute(engine: Running, seconds: float, reason: str) -> None:
    engine.mute = AlertMute(time.monotonic() + seconds, reason)
    why = f": {reason}" if reason else ""
    engine.notices.say(f"alerts are muted for {duration_text(seconds)}{why}" if seconds else "alerts are sent again")


def retuned(command: REFOLDING, engine: Running) -> tuple[str, Tuning]:
    """Return the estimator and the tuning that a command asks for.

    Raises:
        NisusError: If the engine would reject them, with the reason.
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
        families = dict.fromkeys(sensor.family for sensor in engine.model.sensors if sensor.family)
        names = [*families, *engine.model.sensor_names]
        if command.name not in names:
            near = nearest(command.name, names)
            raise ConfigError(f"UseSensor: name is {quoted(command.name)}, no sensor of {engine.model.name}; {near}")
        return estimator, tuning.set(f"use.{command.name}", command.used)
    values = command.values if isinstance(command, commands.SetTunings) else {command.key: command.value}
    if not values:
        raise ConfigError("SetTunings: values is empty; it takes the value of each key")
    changed: dict[str, Any] = {
        key.removeprefix(OPTION_PREFIX): value for key, value in values.items() if key.startswith(OPTION_PREFIX)
    }
    if changed and isinstance(command, commands.SetTuning):
        raise ConfigError(f"{command.key} is an option of the estimator; set it with SetOption")
    for key, value in values.items():
        if not key.startswith(OPTION_PREFIX):
            tuning = tuning.set(key, value)
    return estimator, _with_options(estimator, tuning, changed, engine) if changed else tuning


def _with_options(estimator: str, tuning: Tuning, changed: Mapping[str, float | str], engine: Running) -> Tuning:
    entry = find_estimator(estimator, engine.model)
    known = entry.complete(changed)
    options = {**tuning.options, **{name: known[name] for name in changed}}
    _check(entry, engine, options)
    return tuning.with_options(options)


def _check(entry: Estimator, engine: Running, options: Mapping[str, float]) -> None:
    """Reject options that a fold would reject, also for measurements that are still to come."""
    values = checked(entry, engine.model, options)
    if engine.twin.plan.brings_variances or engine.twin.late.inflate:
        check_variances(entry, values)


def maintained_states(what: str, states: Sequence[str], model: StateSpaceModel) -> list[int]:
    """Return the indices of the states that a maintenance concerns, ascending.

    Raises:
        ConfigError: If the description is missing or too long, or a state is missing, unknown or named twice.
    """
    if not what.strip() or len(what) > MAX_MAINTENANCE_TEXT or printable(what) != what or "\n" in what:
        raise ConfigError(
            f"Maintenance: what is {quoted(what)}; describe the change in 1 to {MAX_MAINTENANCE_TEXT} characters"
        )
    if not states:
        raise ConfigError("Maintenance: states is empty; name the states that it concerns")
    for name in states:
        if name not in model.state_names:
            near = nearest(name, model.state_names[:1000])
            raise ConfigError(f"Maintenance: {model.name} has no state {quoted(name)}; {near}")
    if len(set(states)) != len(states):
        raise ConfigError("Maintenance: states names one twice; name each once")
    return sorted(model.state_names.index(name) for name in states)


def playback(
    source: Source, command: commands.Pause | commands.Speed | commands.Seek | commands.Step, first: int
) -> Callable[[], object]:
    """Check one of `PLAYBACK`, and return what carries it out; `first` is the time of the first event, ns.

    Raises:
        ConfigError: If the source cannot be paused or sought, the speed is not positive or too large, or the time too
            far.
    """
    if isinstance(command, commands.Speed) and not (0.0 < command.factor <= MAX_SPEED or command.factor == math.inf):
        raise ConfigError(
            f"Speed: factor is {command.factor:g}; it must be positive and at most {MAX_SPEED:g}, or inf for as fast "
            "as possible"
        )
    if isinstance(command, commands.Seek) and not abs(command.seconds) <= MAX_SEEK_S:
        raise ConfigError(f"Seek: seconds is {command.seconds:g}; it must lie within {MAX_SEEK_S:g} s")
    paced = controls_of(source)
    if paced is None:
        raise ConfigError("a live source cannot be paused, stepped or sought; only a replay or a simulation can")
    match command:
        case commands.Pause(paused):
            return paced.pause if paused else paced.resume
        case commands.Speed(factor):
            return partial(paced.set_speed, factor)
        case commands.Step():
            return paced.step
    span = span_of(paced)
    return partial(paced.seek, (span[0] if span else first) + round(command.seconds * 1e9))
