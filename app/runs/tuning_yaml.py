"""The settings of a run as lines that can stand in place of those in the twin's file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from config.schema import TwinSection
from estimators.errors import LARGEST
from estimators.estimator import Estimator
from estimators.registry import find_entry
from estimators.tuning import REOPEN, Tuning

from ..twin.bounds import bounds_of

PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
RESERVED = {"null", "true", "false"}


def tuning_yaml(
    config: TwinSection, estimator: str, tuning: Tuning, prior: tuple[np.ndarray, np.ndarray] | None = None
) -> str:
    """The sections `estimator`, `filters`, `parameters`, `noise`, `sensors` and `gate`, whole.

    A twin whose file has these in place of its own starts with the same settings. What else a section of the file says
    (limits of a sensor, options of other filters) is in them as it was; its comments are not.

    Args:
        config: What the twin's file says.
        estimator: Of the run.
        tuning: The same.
        prior: Mean (nx,) and covariance (nx, nx), diagonal, where they are not the file's: a section `prior` too.
    """
    entry, first = find_entry(estimator), config.estimator
    options = {name: _option(entry, name, value) for name, value in tuning.options.items()}
    filters = {**config.filters, first.name: {**config.filters.get(first.name, {}), **first.options}}
    others = {name: dict(given) for name, given in filters.items() if given and name != estimator}
    lines = [f"estimator: {_flow({'name': estimator, 'options': options} if options else estimator)}"]
    lines += _section("filters", others)
    model = tuning.model
    values = dict(zip((item.name for item in model.parameters), map(float, tuning.p), strict=True))
    known = {item.name: item.value for item in model.parameters}
    # Of those that are estimated the tuning has none.
    turned = {name: value for name, value in values.items() if name in config.parameters or value != known[name]}
    lines += _section("parameters", {**config.parameters, **turned})
    ranges = bounds_of(config, model)
    if prior is not None:
        beliefs = zip(model.state_names, prior[0].tolist(), np.sqrt(np.diag(prior[1])).tolist(), strict=True)
        lines += _section("prior", {name: {"mean": mean, "std": std} for name, mean, std in beliefs})
    noises = zip((noise.name for noise in model.noises), map(float, tuning.q), strict=True)
    lines += _section("noise", {name: {"variance": _within(q, ranges.get(f"Q.{name}"))} for name, q in noises})
    lines += _section("sensors", _sensors(config, tuning))
    lines.append(f"gate: {_flow(_gate(tuning))}")
    return "\n".join(lines) + "\n"


def _sensors(config: TwinSection, tuning: Tuning) -> dict[str, Any]:
    found = {}
    ranges = bounds_of(config, tuning.model)
    for sensor, start in zip(tuning.model.sensors, tuning.model.row_start, strict=True):
        given = config.sensors.get(sensor.name)
        own = given.model_dump(mode="json", exclude_unset=True, exclude_none=True) if given is not None else {}
        variances = [float(value) for value in tuning.r[start : start + len(sensor.rows)]]
        rest = {key: value for key, value in own.items() if key not in ("std", "variance", "use")}
        same = all(value == variances[0] for value in variances)
        variance = _within(variances[0] if same else variances, ranges.get(f"R.{sensor.name}"))
        found[sensor.name] = {"variance": variance, **rest}
        if not tuning.get(f"use.{sensor.name}"):
            found[sensor.name]["use"] = False
    return found


def _within(value: float | list[float], bounds: tuple[float, float] | None) -> Any:
    """A variance with the range of its data sheet, unless it was turned beyond that."""
    values = value if isinstance(value, list) else [value]
    if bounds is None or not all(bounds[0] <= item <= bounds[1] for item in values):
        return value
    return {"value": value, "from": bounds[0], **({"to": bounds[1]} if bounds[1] < LARGEST else {})}


def _gate(tuning: Tuning) -> Any:
    if tuning.gate is None:
        return None
    if tuning.gate_kind == "hard" and tuning.reopen == REOPEN:
        return tuning.gate
    reopen = "never" if tuning.reopen is None else tuning.reopen
    return {"probability": tuning.gate, "kind": tuning.gate_kind, "reopen": reopen}


def _option(entry: Estimator, name: str, value: float) -> float | str:
    """An option's value, a choice by its word."""
    choices = next((option.choices for option in entry.options if option.name == name), ())
    return choices[round(value)] if choices else float(value)


def _section(name: str, items: Mapping[str, Any]) -> list[str]:
    return [f"{name}:", *(f"  {_key(key)}: {_flow(value)}" for key, value in items.items())] if items else []


def _key(name: str) -> str:
    return name if PLAIN.fullmatch(name) and name.lower() not in RESERVED else json.dumps(name)


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, str):
        return _key(value)
    if isinstance(value, float) and value == round(value) and abs(value) < 1e15:
        return str(int(value))
    return json.dumps(value)
