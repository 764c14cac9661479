"""One declared sensor for many landmarks: expanded into a sensor for each, which share one entry of the tuning."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

from ..errors import ModelError
from .state_space import Parameter, Sensor, StateSpaceModel
from .wrapping import as_inner

Places = Mapping[str, Mapping[str, Sequence[float]]]
"""Coordinates by declared sensor and landmark, in the order of `Sensor.place`."""


def with_landmarks(model: StateSpaceModel, places: Places) -> StateSpaceModel:
    """Return a model whose sensors with a `place` are replaced by one sensor for each landmark.

    Sensor `sighting` with the landmark 6 becomes `sighting_6`; its coordinates are the parameters `sighting_6_east` and
    so on, which can be set or estimated; panels do not list them.

    Args:
        model: The model.
        places: Coordinates by sensor and landmark, for example {"sighting": {"6": (1.9, -5.6)}}.

    Raises:
        ModelError: If a sensor has no place, no landmark, or a landmark not as many coordinates.
    """
    declared = {sensor.name: sensor for sensor in model.sensors if sensor.place}
    for name in places:
        if name not in declared:
            raise ModelError(f"{model.name}: sensor {name} takes no landmarks; declare its coordinates with place=...")
    sensors: list[Sensor] = []
    parameters = list(model.parameters)
    for sensor in model.sensors:
        if not sensor.place:
            sensors.append(sensor)
            continue
        landmarks = places.get(sensor.name, {})
        if not landmarks:
            raise ModelError(missing(model, sensor))
        for landmark, coordinates in landmarks.items():
            name = f"{sensor.name}_{landmark}"
            if not re.fullmatch(r"\w+", str(landmark)):
                raise ModelError(f"{name}: the landmark {landmark!r} must consist of letters, digits and _")
            if len(coordinates) != len(sensor.place):
                wanted = ", ".join(name for name, _ in sensor.place)
                raise ModelError(f"{name}: has {len(coordinates)} coordinates; {sensor.name} takes {wanted}")
            h = _at(sensor.h, len(parameters), len(sensor.place))
            H = None if sensor.H is None else _at(sensor.H, len(parameters), len(sensor.place))
            sensors.append(replace(sensor, name=name, h=h, H=H, place=(), family=sensor.name))
            parameters += [
                Parameter(f"{name}_{word}", unit, float(value), listed=False)
                for (word, unit), value in zip(sensor.place, coordinates, strict=True)
            ]
    return replace(model, sensors=tuple(sensors), parameters=tuple(parameters))


def missing(model: StateSpaceModel, sensor: Sensor) -> str:
    """Return the message for a sensor whose landmarks are not known."""
    names = ", ".join(name for name, _ in sensor.place)
    return (
        f"{model.name}: sensor {sensor.name} has no landmarks; give them under sensors.{sensor.name}.landmarks of the "
        f"YAML, or by with_landmarks(model, {{{sensor.name!r}: {{'1': ({names})}}}})"
    )


@lru_cache(maxsize=1024)
def _at(function: Callable, first: int, count: int) -> Callable:
    """Return h(x, u, p, out) of h(x, u, p, place, out), whose place is p[first:first + count]."""
    inner = as_inner(function)
    last = first + count

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        inner(x, u, p, p[first:last], out)

    return h
