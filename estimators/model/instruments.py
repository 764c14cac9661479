"""Offsets and scales of sensors and inputs as parameters: y = scale·h(x) + offset, f(x, scale·u + offset).

They may be held at the values of a calibration, fitted, considered or estimated, as all parameters (assemble.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..errors import ModelError
from ..numerics.jit import inlined, stack_vector
from .state_space import Field, Input, Parameter, Row, StateSpaceModel
from .wrapping import as_inner


class Instrument(NamedTuple):
    """Offset and scale of a sensor, y = scale·h + offset, or of an input, scale·u + offset, one a row; empty: none."""

    offset: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()


def instrument_parameters(model: StateSpaceModel, name: str, kind: str) -> list[str]:
    """Return the names of the parameters of a sensor's or input's offset or scale (`kind`), one for each row."""
    rows = next((sensor.rows for sensor in model.sensors if sensor.name == name), ())
    return [f"{name}_{row.name}_{kind}" for row in rows] if len(rows) > 1 else [f"{name}_{kind}"]


def with_instruments(model: StateSpaceModel, instruments: Mapping[str, Instrument]) -> StateSpaceModel:
    """Return the model with offsets and scales of sensors and inputs as parameters, NAME_offset and NAME_scale.

    Those of several rows are NAME_ROW_offset and NAME_ROW_scale.

    Raises:
        ModelError: If there is no such sensor or input, or it cannot have one: the scale of an angle, a sensor with a
            likelihood of its own, a model whose functions are not compiled.
    """
    if not instruments:
        return model
    if isinstance(model.states, Field) or model.black_box:
        kind = "a field" if isinstance(model.states, Field) else "a black box"
        raise ModelError(f"model {model.name} is {kind}, whose sensors and inputs take no offset or scale")
    sensors = {sensor.name: sensor for sensor in model.sensors}
    inputs = {item.name: k for k, item in enumerate(model.inputs)}
    added: list[Parameter] = []
    places: dict[str, tuple[tuple[int, int], ...]] = {}  # of each row: positions in p of its scale and offset, or -1
    for name, given in instruments.items():
        if (name in sensors) == (name in inputs):
            why = "both a sensor and an input" if name in sensors else "no sensor or input"
            raise ModelError(f"model {model.name} has {why} {name!r}, for an offset or a scale")
        sensor = sensors.get(name)
        if sensor is not None and sensor.log_likelihood is not None:
            raise ModelError(f"model {model.name}: {name} has a likelihood of its own, which takes no offset or scale")
        rows: Sequence[Row | Input] = sensor.rows if sensor is not None else (model.inputs[inputs[name]],)
        if given.scale and any(isinstance(row, Row) and row.circular for row in rows):
            raise ModelError(f"model {model.name}: {name} is an angle, which takes no scale; give its offset")
        found = [[-1, -1] for _ in rows]
        for at, kind, values in ((0, "scale", given.scale), (1, "offset", given.offset)):
            low = 0.0 if kind == "scale" else -np.inf
            for k, value in enumerate(values):
                found[k][at] = len(model.parameters) + len(added)
                own = instrument_parameters(model, name, kind)[k]
                added.append(Parameter(own, "1" if kind == "scale" else rows[k].unit, value, low))
        places[name] = tuple((scale, offset) for scale, offset in found)
    taken = {item.name for item in model.parameters}.intersection(item.name for item in added)
    if taken:
        raise ModelError(f"model {model.name} has a parameter {min(taken)!r} already; rename it in the model")
    k = len(model.parameters)
    driven = tuple(places.get(item.name, ((-1, -1),))[0] for item in model.inputs)
    driven = driven if any(place != (-1, -1) for place in driven) else ()
    return replace(
        model,
        parameters=(*model.parameters, *added),
        f=_driven(model.f, k, driven),
        F=model.F and _driven(model.F, k, driven),
        Q=model.Q and _driven(model.Q, k, driven),
        sensors=tuple(
            replace(
                sensor,
                h=_driven_sensor(sensor.h, k, driven, places.get(sensor.name, ())),
                H=sensor.H and _driven(sensor.H, k, driven) if sensor.name not in places else None,
                log_likelihood=sensor.log_likelihood and _driven_likelihood(sensor.log_likelihood, k, driven),
            )
            for sensor in model.sensors
        ),
        jump=model.jump and replace(model.jump, chances=_driven(model.jump.chances, k, driven)),
    )


@inlined
def _drive(driven, u, p, v):
    """Fill v (nu,) with the inputs, scaled and shifted by the parameters at `driven`."""
    for j in range(u.size):
        scale, offset = driven[j]
        v[j] = u[j] * p[scale] if scale >= 0 else u[j]
        if offset >= 0:
            v[j] += p[offset]


@lru_cache(maxsize=256)
def _driven(function: Callable, k: int, driven: tuple) -> Callable:
    """Return f, F, Q, h, H or the chances of a jump, (x, u, p, ...), of the inputs as they drive the model."""
    inner = as_inner(function)

    def same(x, u, p, *rest):  # noqa: ANN001, ANN002, ANN202
        inner(x, u, p[:k], *rest)

    def moved(x, u, p, *rest):  # noqa: ANN001, ANN002, ANN202
        v = stack_vector(p[0], driven)
        _drive(driven, u, p, v)
        inner(x, v, p[:k], *rest)

    return moved if driven else same


@lru_cache(maxsize=256)
def _driven_sensor(function: Callable, k: int, driven: tuple, read: tuple) -> Callable:
    h = _driven(function, k, driven)
    if not read:
        return h
    within = as_inner(h)

    def instrument(x, u, p, out):  # noqa: ANN001, ANN202
        within(x, u, p, out)
        for i in range(len(read)):
            scale, offset = read[i]
            if scale >= 0:
                out[i] *= p[scale]
            if offset >= 0:
                out[i] += p[offset]

    return instrument


@lru_cache(maxsize=256)
def _driven_likelihood(function: Callable, k: int, driven: tuple) -> Callable:
    inner = as_inner(function)

    def same(y, x, u, p, r):  # noqa: ANN001, ANN202
        return inner(y, x, u, p[:k], r)

    def log_likelihood(y, x, u, p, r):  # noqa: ANN001, ANN202
        v = stack_vector(p[0], driven)
        _drive(driven, u, p, v)
        return inner(y, x, v, p[:k], r)

    return log_likelihood if driven else same
