"""The matrix of mistakes: in the tuning, in every sensor and input, in time, in the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from estimators.diagnostics.sensitivity.responses import (
    DELAY,
    DRIFT,
    INPUT_,
    INPUT_SCALE,
    INPUT_STUCK,
    PARAMETER,
    PRIOR,
    R_,
    SCALE,
    SENSOR,
    SPIKES,
    STUCK,
    SWAP,
    SWAPPED,
)
from estimators.errors import ConfigError
from estimators.log import INPUT, READING, Events
from estimators.model.state_space import Sensor, StateSpaceModel
from estimators.tuning import Tuning
from sources.faults.kinds import Fault

from .scenario import ANY_SUBJECT, Mistake

SMALL_BANDS = frozenset({"narrow", "correlated", "shifted"})  # causes that show an overconfident filter

LARGE_BANDS = frozenset({"wide", "alternating"})
SHIFT = frozenset({"shifted", "refused"})
MODEL = frozenset({"shifted", "correlated", "narrow", "refused"})
"""What shows where the model pulls another way than the asset goes."""

INPUT_WRONG = MODEL | {"outside"}
NOTHING: frozenset[str] = frozenset()

PRIOR_SIGMAS, PRIOR_CERTAINTY = 5.0, 20.0  # offset of a wrong prior, and how many times its deviation is too small
MAX_PAIRS = 20  # pairs of faults at once


def matrix(model: StateSpaceModel, tuning: Tuning, events: Events, *, asset: bool) -> list[Mistake]:
    """The mistakes that can be made with a twin, tuned as it ships; sizes count in its standard deviations.

    `events` is a log of it, which tells how large its inputs are, and which sensors speak; `asset` whether its true
    parameters can be changed, as those of a simulation can.
    """
    # What is done to a sensor that says nothing is done to nobody; swapped with it, another one falls silent.
    spoken = set(events.channel[events.kind == READING].tolist())
    sensors = [sensor for s, sensor in enumerate(model.sensors) if s in spoken]
    faults = [*_of_sensors(model, tuning, sensors), *_of_inputs(model, events), *_of_time(sensors)]
    found = [*_of_noises(model), *_of_priors(model), *faults, *_of_model(model, tuning, asset)]
    # The faults of the source, over the whole log.
    lasting = [replace(one, name=f"{one.name} from the start", from_start=True) for one in faults if one.nudges]
    return [*found, *lasting, *_pairs([*found, *lasting])]


def _pairs(mistakes: Sequence[Mistake]) -> Iterator[Mistake]:
    """Yield pairs of faults of different subjects, both in one window or both over the whole log, drawn at random."""
    known = [item for item in mistakes if item.nudges and not item.of_asset and not item.prior]
    rng = np.random.default_rng(len(known))
    made: set[tuple[str, str]] = set()
    for _ in range(10 * MAX_PAIRS if len(known) > 1 else 0):
        one, other = (known[k] for k in rng.choice(len(known), 2, replace=False))
        names = {name for _, name, _ in one.nudges}
        alike = one.whole == other.whole and names.isdisjoint(name for _, name, _ in other.nudges)
        if not alike or (one.name, other.name) in made or len(made) == MAX_PAIRS:
            continue
        made.add((one.name, other.name))
        yield _both(one, other)


def _both(one: Mistake, other: Mistake) -> Mistake:
    faults = [item.fault for item in (one, other) if item.fault is not None]
    anyone = not one.subjects or not other.subjects
    return Mistake(
        f"{one.name} with {other.name}",
        one.causes | other.causes,
        ANY_SUBJECT if anyone else one.subjects | other.subjects,
        belief={**one.belief, **other.belief},
        fault=(lambda start, end: [item for each in faults for item in each(start, end)]) if faults else None,
        shifts=one.shifts and other.shifts,
        nudges=one.nudges + other.nudges,
        from_start=one.whole and bool(faults),
        parts=2,
    )


def _of_noises(model: StateSpaceModel) -> Iterator[Mistake]:
    q, r = [noise.name for noise in model.noises], list(model.row_names)
    for kind, names, factor, causes in (
        ("R", r, 10.0, LARGE_BANDS),
        ("R", r, 100.0, LARGE_BANDS),
        ("R", r, 0.1, frozenset({"narrow", "alternating"})),
        ("Q", q, 0.1, SMALL_BANDS),
        ("Q", q, 0.01, SMALL_BANDS),
        ("Q", q, 100.0, LARGE_BANDS),
    ):
        label = f"{kind} x{factor:g}" if factor > 1.0 else f"{kind} /{1.0 / factor:g}"
        belief = {f"{kind}.{name}": factor for name in names}
        yield Mistake(label, causes, belief=belief, nudges=tuple((kind, name, factor - 1.0) for name in names))


def _of_priors(model: StateSpaceModel) -> Iterator[Mistake]:
    for state, std in zip(model.states, model.prior_std.tolist(), strict=True):
        if std > 0.0:
            yield Mistake(
                f"prior of {state.name} {PRIOR_SIGMAS:g} σ off and {PRIOR_CERTAINTY:g} times too certain",
                SMALL_BANDS | SHIFT,
                frozenset({f"prior {state.name}"}),
                prior={state.name: (PRIOR_SIGMAS, 1.0 / PRIOR_CERTAINTY)},
                nudges=((PRIOR, state.name, PRIOR_SIGMAS * std),),
            )


def _fault(kind: str, **given: object) -> Callable[[float, float], list[Fault]]:
    """A fault of that kind, in a window."""
    return lambda start, end: [Fault(kind, start=start, end=end, **given)]  # type: ignore[arg-type]


def _damage(
    name: str, causes: frozenset[str], nudge: tuple[str, str, float], kind: str, *, subjects: frozenset[str],
    shifts: bool = False, **given: object,
) -> Mistake:  # fmt: skip
    """Return a fault of that kind of the source, which `nisus check` knows as `nudge`."""
    return Mistake(name, causes, subjects, fault=_fault(kind, **given), shifts=shifts, nudges=(nudge,))


def _late(sensor: str, seconds: float) -> Callable[[float, float], list[Fault]]:
    """Measurements that are stamped so long after they were taken, when they arrive."""
    kinds = ("clock_jump", "delay")
    return lambda start, end: [Fault(kind, sensor, start=start, end=end, size=seconds) for kind in kinds]


def _of_sensors(model: StateSpaceModel, tuning: Tuning, sensors: Sequence[Sensor]) -> Iterator[Mistake]:
    for sensor in sensors:
        name, std = sensor.name, float(np.sqrt(tuning.r[model.row_start[model.sensor_names.index(sensor.name)]]))
        own = frozenset({name, *(row.name for row in sensor.rows)})
        # Of several rows the first is tried.
        row = sensor.rows[0].name if len(sensor.rows) > 1 else None
        label = name if row is None else f"{name}.{row}"
        make = partial(_damage, subjects=own, sensor=name, row=row)
        for sigmas in (2.0, 5.0, 20.0):
            words, size = f"{label} +{sigmas:g} σ", sigmas * std
            biased = make(words, SHIFT, (SENSOR, label, size), "bias", shifts=True, size=size)
            yield replace(biased, size=size, unit=sensor.rows[0].unit)
        for seconds in (10.0, 100.0):
            words, rate = f"{label} drifts 1 σ in {seconds:g} s", std / seconds
            yield make(words, SHIFT | {"correlated"}, (DRIFT, label, rate), "drift", shifts=True, size=rate)
        # The twin's R is a tenth of the asset's.
        nudge = (R_, label, 0.1 - 1.0)
        yield make(f"{label} noise x3", frozenset({"narrow", "refused"}), nudge, "noise", size=3.0 * std)
        nudge = (SPIKES, label, 10.0 * std)
        yield make(f"{label} spikes 1 %", frozenset({"spiky"}), nudge, "spike", size=10.0 * std, rate=0.01)
        for factor in (1.02, 1.1):
            nudge = (SCALE, label, factor - 1.0)
            yield make(f"{label} x{factor:g}", MODEL, nudge, "scale", shifts=True, size=factor)
        yield _damage(f"{name} stuck", frozenset({"stuck"}), (STUCK, name, 1.0), "stuck", subjects=own, sensor=name)
        if len(model.sensors) > 1 and not sensor.by_chance:
            yield Mistake(f"{name} silent", frozenset({"silent"}), own, fault=_fault("silence", sensor=name))
    if len(model.sensors) > 1:
        yield Mistake("all stuck", frozenset({"stuck"}), fault=_fault("stuck"))
    yield Mistake("all silent", frozenset({"silent", "stale"}), fault=_silent(model))
    pair = _alike(sensors)
    if pair is not None:
        first, second = pair
        # With its mean each gets the noise of the other.
        nudge, own = (SWAP, f"{first}{SWAPPED}{second}", 1.0), frozenset(pair)
        yield _damage(f"{first} and {second} swapped", MODEL, nudge, "swap", subjects=own, sensor=first, other=second)


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
        make = partial(_damage, subjects=frozenset({f"input {item.name}"}), shifts=True, input=item.name)
        # Half of what it varies by, or a quarter of what it is where it does not.
        size = float(0.5 * np.ptp(values)) or float(0.25 * np.abs(values).mean())
        if size:
            words = f"{item.name} +{size:.3g} {item.unit}"
            biased = make(words, INPUT_WRONG, (INPUT_, item.name, size), "bias", size=size)
            yield replace(biased, size=size, unit=item.unit)
            for factor in (1.1, 1.3):
                nudge = (INPUT_SCALE, item.name, factor - 1.0)
                yield make(f"{item.name} x{factor:g}", INPUT_WRONG, nudge, "scale", size=factor)
        if np.ptp(values):
            yield make(f"{item.name} lost", INPUT_WRONG, (INPUT_STUCK, item.name, 1.0), "silence")


def _of_time(sensors: Sequence[Sensor]) -> Iterator[Mistake]:
    """Yield time faults, which the log corrects or cannot correct."""
    yield Mistake("all 0.5 s late", NOTHING, fault=_fault("delay", size=0.5))
    yield Mistake("all late by chance, 0.2 s", NOTHING, fault=_fault("jitter", size=0.2))
    yield Mistake("neighbours in the wrong order", NOTHING, fault=_fault("reorder", rate=0.5))
    clock = frozenset({"clock", "silent", "stale", "shifted"})
    for sensor in sensors:
        name, own = sensor.name, frozenset({sensor.name})
        jump, known = _fault("clock_jump", sensor=name, size=-1.0), ((DELAY, name, -1.0),)
        yield Mistake(f"clock of {name} 1 s behind", clock | MODEL, own, fault=jump, nudges=known)
        for seconds in (0.5, 3.0):
            late, known = _late(name, seconds), ((DELAY, name, seconds),)
            yield Mistake(f"{name} {seconds:g} s late", clock | MODEL, own, fault=late, nudges=known)
        again = _fault("duplicate", sensor=name, count=4, every=0.001)
        repeated = frozenset({"duplicate", "stuck", "correlated", "wide"})
        yield Mistake(f"{name} said five times", repeated, own, fault=again)


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
        own = frozenset({f"parameter {item.name}"})
        believed = Mistake(f"{item.name} believed +30 %", MODEL | LARGE_BANDS, own, belief={key: 1.3}, shifts=True)
        believed = replace(believed, nudges=((PARAMETER, item.name, 0.3 * value),))
        yield believed
        if asset:
            changed = _fault("model", parameter=item.name, size=1.3)
            known = ((PARAMETER, item.name, -0.3 * value),)
            changes = replace(believed, belief={}, fault=changed, of_asset=True, nudges=known)
            yield replace(changes, name=f"{item.name} of the asset +30 %")
