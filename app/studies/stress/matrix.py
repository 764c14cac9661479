"""The matrix of mistakes: in the tuning, in every sensor and input, in time, in the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from estimators.errors import ConfigError
from estimators.log import INPUT, READING, Events
from estimators.model.state_space import Sensor, StateSpaceModel
from estimators.tuning import Tuning
from sources.faults.kinds import Fault

from .scenario import Mistake

SMALL_BANDS = frozenset({"narrow", "correlated", "shifted"})  # causes that show an overconfident filter

LARGE_BANDS = frozenset({"wide", "alternating"})
SHIFT = frozenset({"shifted", "refused"})
MODEL = frozenset({"shifted", "correlated", "narrow", "refused"})
"""What shows where the model pulls another way than the asset goes."""

INPUT_WRONG = MODEL | {"outside"}
NOTHING: frozenset[str] = frozenset()


def matrix(model: StateSpaceModel, tuning: Tuning, events: Events, *, asset: bool) -> list[Mistake]:
    """The mistakes that can be made with a twin, tuned as it ships; sizes count in its standard deviations.

    `events` is a log of it, which tells how large its inputs are, and which sensors speak; `asset` whether its true
    parameters can be changed, as those of a simulation can.
    """
    # What is done to a sensor that says nothing is done to nobody; swapped with it, another one falls silent.
    spoken = set(events.channel[events.kind == READING].tolist())
    sensors = [sensor for s, sensor in enumerate(model.sensors) if s in spoken]
    return [
        *_of_noises(model),
        *_of_sensors(model, tuning, sensors),
        *_of_inputs(model, events),
        *_of_time(sensors),
        *_of_model(model, tuning, asset),
    ]


def _of_noises(model: StateSpaceModel) -> Iterator[Mistake]:
    q = [f"Q.{noise.name}" for noise in model.noises]
    r = [f"R.{name}" for name in model.row_names]
    for factor in (10.0, 100.0):
        yield Mistake(f"R x{factor:g}", LARGE_BANDS, belief=dict.fromkeys(r, factor))
    yield Mistake("R /10", frozenset({"narrow", "alternating"}), belief=dict.fromkeys(r, 0.1))
    for factor in (10.0, 100.0):
        yield Mistake(f"Q /{factor:g}", SMALL_BANDS, belief=dict.fromkeys(q, 1.0 / factor))
    yield Mistake("Q x100", LARGE_BANDS, belief=dict.fromkeys(q, 100.0))


def _fault(kind: str, **given: object) -> Callable[[float, float], list[Fault]]:
    """A fault of that kind, in a window."""
    return lambda start, end: [Fault(kind, start=start, end=end, **given)]  # type: ignore[arg-type]


def _rows(model: StateSpaceModel, sensor: Sensor, tuning: Tuning) -> list[tuple[str | None, float]]:
    """The rows of a sensor that are tried, each with its standard deviation: its own row, or the first of several."""
    start = model.row_start[model.sensor_names.index(sensor.name)]
    row = sensor.rows[0].name if len(sensor.rows) > 1 else None
    return [(row, float(np.sqrt(tuning.r[start])))]


def _of_sensors(model: StateSpaceModel, tuning: Tuning, sensors: Sequence[Sensor]) -> Iterator[Mistake]:
    for sensor in sensors:
        name = sensor.name
        own = frozenset({name, *(row.name for row in sensor.rows)})
        for row, std in _rows(model, sensor, tuning):
            label = name if row is None else f"{name}.{row}"
            for size in (2.0, 5.0, 20.0):
                fault = _fault("bias", sensor=name, row=row, size=size * std)
                plain = Mistake(f"{label} +{size:g} σ", SHIFT, own, fault=fault, shifts=True)
                yield replace(plain, size=size * std, unit=sensor.rows[0].unit)
            drift = _fault("drift", sensor=name, row=row, size=0.1 * std)
            yield Mistake(f"{label} drifts 1 σ in 10 s", SHIFT | {"correlated"}, own, fault=drift, shifts=True)
            noisy = _fault("noise", sensor=name, row=row, size=3.0 * std)
            yield Mistake(f"{label} noise x3", frozenset({"narrow", "refused"}), own, fault=noisy)
            spikes = _fault("spike", sensor=name, row=row, size=10.0 * std, rate=0.01)
            yield Mistake(f"{label} spikes 1 %", frozenset({"spiky"}), own, fault=spikes)
            scaled = _fault("scale", sensor=name, row=row, size=1.1)
            yield Mistake(f"{label} x1.1", MODEL, own, fault=scaled, shifts=True)
        yield Mistake(f"{name} stuck", frozenset({"stuck"}), own, fault=_fault("stuck", sensor=name))
        lost = _fault("silence", sensor=name)
        if len(model.sensors) > 1:
            yield Mistake(f"{name} silent", frozenset({"silent"}), own, fault=lost)
    if len(model.sensors) > 1:
        yield Mistake("all stuck", frozenset({"stuck"}), fault=_fault("stuck"))
    yield Mistake("all silent", frozenset({"silent", "stale"}), fault=_silent(model))
    pair = _alike(sensors)
    if pair is not None:
        first, second = pair
        swapped = _fault("swap", sensor=first, other=second)
        # With its mean each gets the noise of the other.
        yield Mistake(f"{first} and {second} swapped", MODEL, frozenset(pair), fault=swapped)


def _silent(model: StateSpaceModel) -> Callable[[float, float], list[Fault]]:
    names = model.sensor_names
    return lambda start, end: [Fault("silence", name, start=start, end=end) for name in names]


def _alike(sensors: Sequence[Sensor]) -> tuple[str, str] | None:
    """The first two sensors whose readings could be taken for each other's."""
    for k, one in enumerate(sensors):
        for other in sensors[k + 1 :]:
            if [row.unit for row in one.rows] == [row.unit for row in other.rows]:
                return one.name, other.name
    return None


def _of_inputs(model: StateSpaceModel, events: Events) -> Iterator[Mistake]:
    told = events.value[events.kind == INPUT]
    for k, item in enumerate(model.inputs):
        values = told[:, k][np.isfinite(told[:, k])]
        if not values.size:
            continue
        # Half of what it varies by, or a quarter of what it is where it does not.
        size = float(0.5 * np.ptp(values)) or float(0.25 * np.abs(values).mean())
        if size:
            biased = _fault("bias", input=item.name, size=size)
            name = f"{item.name} +{size:.3g} {item.unit}"
            yield Mistake(name, INPUT_WRONG, fault=biased, size=size, unit=item.unit, shifts=True)
            scaled = _fault("scale", input=item.name, size=1.3)
            yield Mistake(f"{item.name} x1.3", INPUT_WRONG, fault=scaled, shifts=True)
        if np.ptp(values):
            lost = _fault("silence", input=item.name)
            yield Mistake(f"{item.name} lost", INPUT_WRONG, fault=lost, shifts=True)


def _of_time(sensors: Sequence[Sensor]) -> Iterator[Mistake]:
    """Yield time faults, which the log corrects or cannot correct."""
    yield Mistake("all 0.5 s late", NOTHING, fault=_fault("delay", size=0.5))
    yield Mistake("all late by chance, 0.2 s", NOTHING, fault=_fault("jitter", size=0.2))
    yield Mistake("neighbours in the wrong order", NOTHING, fault=_fault("reorder", rate=0.5))
    clock = frozenset({"clock", "silent", "stale", "shifted"})
    for sensor in sensors:
        name = sensor.name
        jump = _fault("clock_jump", sensor=name, size=-1.0)
        yield Mistake(f"clock of {name} 1 s behind", clock | MODEL, frozenset({name}), fault=jump)
        again = _fault("duplicate", sensor=name, count=4, every=0.001)
        repeated = frozenset({"duplicate", "stuck", "correlated", "wide"})
        yield Mistake(f"{name} said five times", repeated, frozenset({name}), fault=again)


def _of_model(model: StateSpaceModel, tuning: Tuning, asset: bool) -> Iterator[Mistake]:
    for item in model.parameters:
        key = f"p.{item.name}"
        try:
            value = float(tuning.get(key) or 0.0)
            tuning.set(key, 1.3 * value)
        except ConfigError:
            continue  # out of the range in which it makes sense
        if not value:
            continue
        believed = Mistake(f"{item.name} believed +30 %", MODEL | LARGE_BANDS, belief={key: 1.3}, shifts=True)
        yield believed
        if asset:
            changed = _fault("model", parameter=item.name, size=1.3)
            yield replace(believed, name=f"{item.name} of the asset +30 %", belief={}, fault=changed, of_asset=True)
