"""What inputs do from now on, where that is asked: as events, as points to draw, and as they were before."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimators.errors import ConfigError
from estimators.log import INPUT, Events
from estimators.model.state_space import StateSpaceModel

from ...live.interface import Running
from .numbers import listed

REPEAT = "repeat"
"""In place of an input's values: what it was, once more."""

Changes = list[tuple[float, float]]
"""Of one input: seconds from now, and the value from then on."""

MOST_STEPS = 20_000
"""Steps of a forecast; each is as long as readings are apart."""

TIMES = 160
"""Times that are told of."""

ROWS = 16_384
"""Rows copied at once, so that a long history does not hold the engine's lock for long."""


def recorded(engine: Running, names: Sequence[str], now: int, horizon: float) -> dict[str, Changes]:
    """What inputs did in the last `horizon` seconds before `now` (ns), from now on; of a shorter log again and again.

    Raises:
        ConfigError: If they changed too often.
    """
    if not names:
        return {}
    model = engine.model
    since = max(engine.span()[0], now - round(horizon * 1e9))
    length = max(1, now - since)
    places = {name: model.input_names.index(name) for name in names}
    before: dict[str, float] = {}
    found: dict[str, Changes] = {name: [] for name in names}
    # From some rows before, for what held at first.
    at, end = max(0, engine.index_at(since) - ROWS), engine.index_at(now + 1)
    while at < end:
        events = engine.rows(at, min(end, at + ROWS)).events
        at += ROWS
        for row in np.flatnonzero(events.kind == INPUT):
            for name, place in places.items():
                value = float(events.value[row, place])
                if math.isnan(value):
                    continue
                if events.t[row] <= since:
                    before[name] = value
                else:
                    found[name].append(((int(events.t[row]) - since) * 1e-9, value))
    times = math.ceil(horizon * 1e9 / length)
    for name, changes in found.items():
        changes[:0] = [(0.0, before[name])] if name in before else []
        if len(changes) * times > MOST_STEPS:
            raise ConfigError(
                f"forecast: {name} changed {len(changes):,} times in {length * 1e-9:.4g} s, too often to be repeated "
                f"for {horizon:g} s; ask for a shorter horizon"
            )
    return {
        name: [
            (t + k * length * 1e-9, value)
            for k in range(times)
            for t, value in changes
            if t + k * length * 1e-9 <= horizon
        ]
        for name, changes in found.items()
        if changes
    }


def told_changes(changes: Changes) -> dict[str, list[Any]]:
    """What an input does from now on, as some points to draw."""
    few = changes[:: max(1, math.ceil(len(changes) / (2 * TIMES)))]
    return {"t": listed(np.array([t for t, _ in few])), "value": listed(np.array([value for _, value in few]))}


def input_events(inputs: Mapping[str, Changes], now: int, model: StateSpaceModel) -> Events | None:
    """The changes of the inputs as events."""
    batch = []
    for name, changes in inputs.items():
        n = len(changes)
        t = np.array([now + round(seconds * 1e9) for seconds, _ in changes], np.int64)
        rows = np.full((n, model.width), np.nan)
        rows[:, model.input_names.index(name)] = [value for _, value in changes]
        batch.append(Events(t, t.copy(), np.full(n, INPUT, np.int8), np.zeros(n, np.int32), rows))
    return Events.concat(batch, model.width) if batch else None
