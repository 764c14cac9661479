"""What moved the estimate in a span of time, for `nisus why`, the page and the API."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.attribution import Attribution
from estimators.model.state_space import StateSpaceModel

from ..result import Cell, JsonObject, TableColumn, Topic

MODEL, RESTARTS = "model", "restarts"
"""Causes that are neither an input nor a sensor."""

MIN_SHARE = 0.001
"""Share of the largest contribution to a state below which a cause is not listed."""


def causes(model: StateSpaceModel, found: Attribution) -> list[tuple[str, str, int | None, np.ndarray]]:
    """Return kind, name, number of measurements and contribution (n,) of each cause."""
    inputs = [("input", item.name, None, row) for item, row in zip(model.inputs, found.inputs, strict=True)]
    sensors = [
        ("sensor", name, int(count), row)
        for name, count, row in zip(model.sensor_names, found.readings, found.sensors, strict=True)
    ]
    return [(MODEL, MODEL, None, found.model), *inputs, *sensors, (RESTARTS, RESTARTS, None, found.restarts)]


def why_json(model: StateSpaceModel, found: Attribution, origin: int) -> JsonObject:
    """Return the changes by state; times in seconds after `origin`, ns."""
    listed = causes(model, found)
    return {
        "start": (found.t[0] - origin) * 1e-9,
        "end": (found.t[1] - origin) * 1e-9,
        "readings": dict(zip(model.sensor_names, found.readings.tolist(), strict=True)),
        "states": {
            state.name: {
                "unit": state.unit,
                "before": found.before[j],
                "after": found.after[j],
                **{
                    f"{kind}s": {name: change[j] for other, name, _, change in listed if other == kind}
                    for kind in ("input", "sensor")
                },
                MODEL: found.model[j],
                RESTARTS: found.restarts[j],
                "largest": [
                    {"t": (item.t - origin) * 1e-9, "sensor": model.sensor_names[item.sensor], "change": item.change}
                    for item in found.largest[j]
                ],
            }
            for j, state in enumerate(model.shown_states)
        },
    }


def why_topics(model: StateSpaceModel, found: Attribution, origin: int, chosen: Sequence[int]) -> list[Topic]:
    """Return a table of the causes with a column for each chosen state, and their largest corrections."""
    largest = [np.max(np.abs([change[j] for *_, change in causes(model, found)])) for j in chosen]
    rows: list[tuple[Cell, ...]] = []
    for kind, name, count, change in causes(model, found):
        if any(abs(change[j]) > MIN_SHARE * most for j, most in zip(chosen, largest, strict=True)) or count:
            text = name if kind == name else f"{kind} {name}"
            rows.append((text, count, *(float(change[j]) for j in chosen)))
    total = found.after - found.before
    rows.append(("in all", None, *(float(total[j]) for j in chosen)))
    names = [
        f"{state.name} [{state.unit}]" if state.unit not in ("", "1") else state.name for state in model.shown_states
    ]
    singles = tuple(
        (names[j], (item.t - origin) * 1e-9, model.sensor_names[item.sensor], item.change)
        for j in chosen
        for item in found.largest[j]
    )
    begin, end = ((t - origin) * 1e-9 for t in found.t)
    return [
        Topic(
            f"Change of the estimate from {begin:.6g} s to {end:.6g} s",
            columns=("by", TableColumn("measurements", absent=""), *(names[j] for j in chosen)),
            rows=tuple(rows),
        ),
        Topic("Largest corrections", columns=("state", TableColumn("time [s]", 3), "by", "change"), rows=singles),
    ]
