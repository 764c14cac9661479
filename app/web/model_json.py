"""What a page must know of a twin before it can draw anything: names, units, ranges, estimators. It never changes."""

from __future__ import annotations

import math
from typing import Any

from estimators.estimator import Estimator, Option
from estimators.registry import ESTIMATORS, unfit

from ..live.interface import Running
from ..present.drawing.direct_readings import observed
from ..present.series.columns import columns_of, rows_of


def model_json(engine: Running) -> dict[str, Any]:
    """The twin in names, units and configured values; every estimator with its options, or why it does not apply."""
    model, twin = engine.model, engine.twin
    view = twin.config.view
    direct = {(dot.sensor, dot.row): int(dot.state) for dot in observed(model)}
    rows = rows_of(model)
    units = {name: model.sensors[sensor].rows[row].unit for name, sensor, row in rows}
    readers: dict[str, list[str]] = {state.name: [] for state in model.shown_states}
    for name, sensor, row in rows:
        state = direct.get((sensor, row))
        if state is not None and model.state_names[state] in readers:
            readers[model.state_names[state]].append(name)
    return {
        "twin": twin.name,
        "title": twin.title,
        "model": model.name,
        "states": [
            {
                "name": state.name,
                "label": model.label(state.name).replace("_", " "),
                "unit": state.unit,
                "circular": bool(getattr(state, "circular", False)),
                "probability": j == model.mode,
                "rows": readers[state.name],
            }
            for j, state in enumerate(model.shown_states)
        ],
        "field": model.grid is not None,
        "rows": [{"name": name, "sensor": model.sensor_names[sensor], "unit": units[name]} for name, sensor, _ in rows],
        "sensors": list(model.sensor_names),
        "inputs": [{"name": item.name, "unit": item.unit, "value": item.default} for item in model.inputs],
        "parameters": [item.name for item in model.parameters],
        "pairs": [[model.shown_states[i].name, model.shown_states[j].name] for i, j in engine.pairs.tolist()],
        "tuning": [
            {
                "key": item.key,
                "unit": item.unit,
                "low": _bound(item.low),
                "high": _bound(item.high),
                "configured": item.value,
            }
            for item in twin.tuning.items()
        ],
        "configured": {
            "estimator": twin.estimator,
            "gate": twin.tuning.gate,
            "gate.kind": twin.tuning.gate_kind,
            "gate.reopen": twin.tuning.reopen,
        },
        "estimators": [
            {
                "name": name,
                "title": entry.title,
                "family": entry.family,
                "assumes": entry.assumes,
                "fails_when": entry.fails_when,
                "source": entry.source,
                "reason": unfit(entry, model),
                "options": [_option(entry, option, engine) for option in entry.options],
            }
            for name, entry in ESTIMATORS.items()
        ],
        "commissioned": twin.tuning.baseline is not None,
        "window": view.window,
        "scene": view.scene.kind,
        "columns": list(columns_of(model)),
    }


def _option(entry: Estimator, option: Option, engine: Running) -> dict[str, Any]:
    configured = dict(engine.twin.options_of(entry.name)).get(option.name, option.default)
    return {
        "name": option.name,
        "default": float(option.default),
        "configured": float(configured),
        "low": _bound(option.low),
        "high": _bound(option.high),
        "unit": option.unit,
        "meaning": option.meaning,
        "choices": list(option.choices),
        "whole": option.whole,
    }


def _bound(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
