"""Settings of a run as YAML that can replace the sections of the twin's file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from config.schema import TwinSection
from config.yaml_files import Key, as_flow, as_section, parse, rounded, with_section, with_values
from estimators.errors import LARGEST
from estimators.estimator import Estimator
from estimators.model.coloured import disturbance_time, error_time, errors_of
from estimators.model.state_space import Field, Input, State, StateSpaceModel
from estimators.registry import find_entry
from estimators.tuning import REOPEN_S, Tuning

from ..result import JsonObject
from .defaults import bounds_of, parameter_sections

if TYPE_CHECKING:
    from estimators.fit.uncertainty import ParameterWidths


def tuning_yaml(
    config: TwinSection,
    estimator: str,
    tuning: Tuning,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    whole: bool = True,
    widths: ParameterWidths | None = None,
) -> str:
    """Return the sections `estimator`, `filters`, `parameters`, `valid_range`, `noise`, `sensors` and `gate`.

    A twin whose file has these in place of its own starts with the same settings.

    Args:
        config: The twin's file.
        estimator: Of the run.
        tuning: Of the run.
        prior: Mean (nx,) and covariance (nx, nx), diagonal, if they are not the file's; adds a section `prior`.
        whole: Whether other content of these sections (limits of a sensor, options of other filters) is kept, without
            its comments. If not, they have the tuned entries only, with every parameter.
        widths: Covariance that a fit gives the parameters, but with `whole` the spread between specimens of those that
            have a `std`; and the ranges of its data, which become the ranges of validity of states and inputs that have
            one or widen a parameter.
    """
    entry, first = find_entry(estimator), config.estimator
    options = {name: _option(entry, name, value) for name, value in tuning.options.items()}
    filters = {**config.filters, first.name: {**config.filters.get(first.name, {}), **first.options}}
    others = {name: dict(given) for name, given in filters.items() if given and name != estimator}
    lines = [f"estimator: {as_flow({'name': estimator, 'options': options} if options else estimator)}"]
    lines += as_section("filters", others) if whole else []
    model = tuning.model
    values = dict(zip((item.name for item in model.parameters), map(float, tuning.p), strict=True))
    noises = dict(zip((noise.name for noise in model.noises), map(float, tuning.q), strict=True))
    known = {item.name: item.value for item in model.parameters}
    # How long errors last stands beside their size. Of parameters that are estimated the tuning has none.
    lasting = {name: section.correlation_time for name, section in config.noise.items() if section.correlation_time}
    erring = [sensor for sensor in model.sensors if sensor.name in config.sensors and config.sensors[sensor.name].error]
    times = {*map(disturbance_time, lasting), *(error_time(sensor.name) for sensor in erring)}
    turned = {name: value for name, value in values.items() if name in config.parameters or value != known[name]}
    given = {name: section.model_dump(mode="json", exclude_unset=True) for name, section in config.parameters.items()}
    # A version replaces another, so it has the widths that are not the fit's too.
    parameters: JsonObject = {
        name: item
        for name, item in given.items()
        if whole or (set(item) - {"value"} and config.parameters[name].role != "estimated")
    }
    for name, value in (turned if whole else values).items():
        parameters[name] = {**parameters.get(name, {}), "value": value}
    if widths is not None:
        _add_widths(parameters, widths, with_spread(config, model, widths) if whole else [])
    parameters = {name: item["value"] if list(item) == ["value"] else item for name, item in parameters.items()}
    kept = {name: item for name, item in parameters.items() if name not in times or name in given}
    lines += as_section("parameters", kept)
    if widths is not None or not whole:
        lines += as_section("valid_range", _fitted_ranges(config, model, widths))
    if prior is not None:
        own = model.states[: model.nx - model.considered]  # the prior of the others is that of their parameters
        ends = np.array([state.limits or (-np.inf, np.inf) for state in own])
        means = np.clip(prior[0][: len(own)], *ends.T).tolist()  # a fit may end a little beyond what is possible
        beliefs = zip(own, means, np.sqrt(np.diag(prior[1])).tolist(), strict=False)
        lines += as_section("prior", {state.name: {"mean": mean, "std": std} for state, mean, std in beliefs})
    errors = {sensor.name: [noises.pop(name) for name in errors_of(sensor)] for sensor in erring}
    times_of = {name: values.get(disturbance_time(name), seconds) for name, seconds in lasting.items()}
    over = {name: {"correlation_time": seconds} for name, seconds in times_of.items()}
    ranges = bounds_of(config, model)
    lines += as_section(
        "noise",
        {name: {"variance": _within(q, ranges.get(f"Q.{name}")), **over.get(name, {})} for name, q in noises.items()},
    )
    lines += as_section("sensors", _sensors(config, tuning, errors, values, whole))
    gate: float | dict[str, object] | None = tuning.gate
    if gate is not None and (tuning.gate_kind != "hard" or tuning.reopen != REOPEN_S):
        reopen = "never" if tuning.reopen is None else tuning.reopen
        gate = {"probability": gate, "kind": tuning.gate_kind, "reopen": reopen}
    lines.append(f"gate: {as_flow(gate)}")
    return "\n".join(lines) + "\n"


CORRELATION_DIGITS = 8
"""A direction that the data determine well has a small share of each deviation: few digits would blur it."""


def with_spread(config: TwinSection, model: StateSpaceModel, widths: ParameterWidths) -> list[str]:
    """Return the parameters of a fit whose `std` in a twin's file is the spread between specimens."""
    sections = parameter_sections(model, config)
    return [name for name in widths.names if name in sections and sections[name].std is not None]


def _add_widths(parameters: JsonObject, widths: ParameterWidths, spread: Sequence[str]) -> None:
    """Add the widths of a fit to the section `parameters`: for those of `spread` that between specimens."""
    for i, name in enumerate(widths.names):
        own = parameters.setdefault(name, {})
        if name in spread:
            # One specimen leaves it as the file has it, perhaps in percent.
            own |= {"std": rounded(widths.spread[i])} if widths.spread[i] != widths.prior[i] else {}
            continue
        own["std"] = rounded(widths.std[i])
        pairs = {other: widths.correlation[i, k] for k, other in enumerate(widths.names[:i]) if other not in spread}
        if pairs:
            own["correlation"] = rounded(pairs, CORRELATION_DIGITS)


def _fitted_ranges(
    config: TwinSection, model: StateSpaceModel, widths: ParameterWidths | None
) -> dict[str, JsonObject]:
    """Return the section `valid_range`: of each state and input that has one or widens a parameter."""
    sections = config.valid_range.items()
    found = {name: section.model_dump(mode="json", exclude_unset=True) for name, section in sections}
    if widths is None:
        return found
    states = () if isinstance(model.states, Field) else model.states
    items: list[State | Input] = [*(state for state in states if not state.appended), *model.inputs]
    limited = {item.name for item in items if item.fitted is not None}
    limited |= {place for section in parameter_sections(model, config).values() for place in section.widen}
    for name in sorted(limited & set(widths.envelope)):
        low, high = widths.envelope[name]
        found.setdefault(name, {}).update({"range": rounded([low, high])})
    return found


def _sensors(
    config: TwinSection,
    tuning: Tuning,
    errors: Mapping[str, list[float]],
    values: Mapping[str, float],
    whole: bool,
) -> JsonObject:
    """Return the section `sensors`, given the variances of coloured errors by sensor, and parameters by name."""
    landmarks = {name: section.landmarks for name, section in config.sensors.items() if section.landmarks and whole}
    found: JsonObject = {
        name: {"landmarks": {key: list(at) for key, at in given.items()}} for name, given in landmarks.items()
    }
    ranges = bounds_of(config, tuning.model)
    for sensor, start in zip(tuning.model.sensors, tuning.model.row_start, strict=True):
        given = config.sensors.get(sensor.name)
        own = given.model_dump(mode="json", exclude_unset=True, exclude_none=True) if given is not None else {}
        variances = [float(value) for value in tuning.r[start : start + len(sensor.rows)]]
        rest = {key: value for key, value in own.items() if whole and key not in ("std", "variance", "use")}
        if sensor.name in errors:
            over = values.get(error_time(sensor.name), own["error"]["correlation_time"])
            rest["error"] = {"variance": _one_or_all(errors[sensor.name]), "correlation_time": over}
        variance = _within(_one_or_all(variances), ranges.get(f"R.{sensor.name}"))
        found[sensor.name] = {"variance": variance, **rest}
        used = bool(tuning.get(f"use.{sensor.name}"))
        if not (whole and used):
            found[sensor.name]["use"] = used
    return found


def _one_or_all(values: list[float]) -> float | list[float]:
    """Return the value that all rows share, or one for each row."""
    return values[0] if all(value == values[0] for value in values) else values


def _within(value: float | list[float], bounds: tuple[float, float] | None) -> object:
    """Return a variance with the range of its data sheet, unless it lies outside."""
    values = value if isinstance(value, list) else [value]
    if bounds is None or not all(bounds[0] <= item <= bounds[1] for item in values):
        return value
    return {"value": value, "range": [bounds[0], bounds[1] if bounds[1] < LARGEST else None]}


def _option(entry: Estimator, name: str, value: float) -> float | str:
    """Return an option's value, a choice by its name."""
    choices = next((option.choices for option in entry.options if option.name == name), ())
    return choices[round(value)] if choices else float(value)


def with_tuning(text: str, before: str, after: str) -> str:
    """Return a twin's YAML with the values in which its tuning `after` differs from that `before`.

    Values stand where the file has them, a variance as `std` where that is given, and comments stay. A section without
    a place for one is replaced as a whole.

    Args:
        text: The twin's file.
        before: Its own settings, see `tuning_yaml`.
        after: The settings to apply.
    """
    old, new = (dict(_leaves(parse(part, "the tuning")[0], ())) for part in (before, after))
    data = parse(text, "the YAML")[0]
    values = dict(_placed(data, key, value) for key, value in new.items() if old.get(key) != value)
    text, missing = with_values(text, values)
    for section in dict.fromkeys(str(key[0]) for key in missing):
        found = re.search(rf"^{section}:.*\n(?:[ ].*\n)*", after, re.MULTILINE)
        text = with_section(text, section, found.group() if found else "")
    return text


def _leaves(value: object, key: Key) -> Iterator[tuple[Key, object]]:
    """Return the values of a section by their keys; a list is a value."""
    if not isinstance(value, Mapping):
        yield key, value
        return
    for name, item in value.items():
        yield from _leaves(item, (*key, name))


def _placed(data: object, key: Key, value: Any) -> tuple[Key, Any]:
    """Return the key under which a file has a value, with the value as it stands there."""
    found: list[str | int] = []
    for name in key:
        if name == "variance" and isinstance(data, Mapping) and "variance" not in data and "std" in data:
            name = "std"
            value = rounded(np.sqrt(value).tolist(), 6)
        if name == "range" and isinstance(data, list):
            break  # [20, 38] is the short form of {range: [20, 38]}
        found.append(name)
        data = data.get(name) if isinstance(data, Mapping) else None
    if isinstance(data, Mapping) and "value" in data:
        found.append("value")
    return tuple(found), value
