"""The model of a twin: found by name or in the user's file, then set up as the twin's YAML says."""

from __future__ import annotations

import hashlib
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf, log, sqrt
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from config.extensions import maker
from config.fields import bounds
from config.loader import Loaded, shown_path
from config.model_schema import Model, kind_of, model_file
from config.schema import ParameterSection, PriorSection, SensorSection, TwinSection
from config.yaml_files import Key, dotted
from estimators.errors import ConfigError, ModelError, NisusError, nearest, spaced
from estimators.model.assemble import AppendError, JointParameter, assemble
from estimators.model.coloured import ColouredError, disturbance_time, error_time
from estimators.model.hybrid import learned_noise
from estimators.model.instruments import Instrument
from estimators.model.parts import Correlation, Limits, Stuck, correlation_error
from estimators.model.state_space import Field, Sensor, State, StateSpaceModel
from estimators.model.user_file import imported_beside, run_file
from estimators.models import MODELS
from estimators.plausibility import DAY, surprise

from .checks import check_named, check_names, estimated_names, row_variances
from .defaults import instrument_sections, parameter_sections
from .landmarks import expanded
from .matrices import matrices_model
from .sources.kind import signal_ends

T = TypeVar("T")


def find_model(loaded: Loaded, key: Key, reference: Model) -> StateSpaceModel:
    """Return the model that `reference`, the value at `key`, means.

    It is a name, ./file.py:Name beside the YAML, or the section of a file of matrices or of an extension.

    Raises:
        ConfigError: If there is no such model or file.
        ModelError: If the user's file fails, with its file and line.
    """
    if not isinstance(reference, str):
        kind = kind_of(reference)
        make: Callable[..., StateSpaceModel] = matrices_model if kind == "matrices" else maker("models", kind)
        return make(loaded, reference, _existing(loaded, (*key, kind), model_file(reference)))
    file, _, name = reference.rpartition(":")
    if not file and not reference.endswith(".py"):
        if reference in MODELS:
            return MODELS[reference]
        near = nearest(reference, MODELS).rstrip("?")
        raise loaded.error(key, f"is {reference!r}; no model of that name ships; {near}, or write ./file.py:Name")
    if not file or not name:
        raise loaded.error(key, f"is {reference!r}; name what to take from the file, as in ./pump.py:Pump")
    path = _existing(loaded, key, reference, file)
    module = _import(path)
    if not hasattr(module, name):
        names = [item for item in vars(module) if not item.startswith("_")]
        raise loaded.error(key, f"is {reference!r}; {shown_path(path)} has no {name}; {nearest(name, names)}")
    return _as_model(getattr(module, name), name, path, loaded, key)


def model_files(loaded: Loaded) -> tuple[Path, ...]:
    """Return the user's file of the model, those beside it that it imports, and that of its correction."""
    model, learned = loaded.config.model, loaded.config.correction
    correction = () if learned is None else (_beside(loaded, learned),)
    if not isinstance(model, str):
        return (_beside(loaded, model_file(model)), *correction)
    file = model.rpartition(":")[0]
    if not file:
        return correction
    path = _beside(loaded, file)
    return (path, *imported_beside(path), *correction)


def _existing(loaded: Loaded, key: Key, reference: str, file: str | None = None) -> Path:
    """Return the path of a model's file, which must exist; `reference` is the value at `key`."""
    path = _beside(loaded, reference if file is None else file)
    if not path.is_file():
        raise loaded.error(key, f"is {reference!r}; there is no file {shown_path(path)}; it is sought beside the YAML")
    return path


def _beside(loaded: Loaded, file: str) -> Path:
    path = Path(file).expanduser()
    return path if path.is_absolute() else loaded.path.absolute().parent / path


def _import(path: Path) -> ModuleType:
    """Run a user's file as a module of a name of its own, with its folder importable meanwhile."""
    path = path.resolve()
    if path.suffix != ".py":
        raise ModelError(f"{shown_path(path)}: it is not a Python file; its name must end in .py")
    unique = f"nisus_model_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    try:
        return run_file(unique, path)
    except (Exception, SystemExit) as error:
        raise _blame(error, path) from error


def _as_model(found: object, name: str, path: Path, loaded: Loaded, key: Key) -> StateSpaceModel:
    if not isinstance(found, StateSpaceModel) and callable(found):
        try:
            found = found()
        except (Exception, SystemExit) as error:
            raise _blame(error, path.resolve()) from error
    if not isinstance(found, StateSpaceModel):
        raise loaded.error(
            key, f"names {name}, which is of type {type(found).__name__}; it must be a StateSpaceModel, or return one"
        )
    return found


def _blame(error: BaseException, path: Path) -> ModelError:
    """Return one line with the place in the user's code from which an exception came."""
    if isinstance(error, SyntaxError) and error.filename:
        return ModelError(f"{shown_path(Path(error.filename))}:{error.lineno}: {error.msg}; correct the Python")
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(path.parent)]
    place = f"{shown_path(Path(own[-1].filename))}:{own[-1].lineno}" if own else shown_path(path)
    text = " ".join(str(error).split()) or "no message"
    if isinstance(error, NisusError):
        return ModelError(f"{place}: {text}")
    return ModelError(f"{place}: {type(error).__name__}: {text}; correct the model's file")


def configure(model: StateSpaceModel, loaded: Loaded) -> StateSpaceModel:
    """Return the model with the YAML's additions, parameters, prior, noise and limits.

    Raises:
        ConfigError: With file and line, if the YAML names something that the model lacks, or a value breaks its rule.
    """
    config = loaded.config
    model = _assembled(_with_noise(with_parameters(model, loaded), loaded), loaded)
    field = isinstance(model.states, Field)
    own = () if field else estimated_names(model)  # a field may have a million
    places = [*own, *(item.name for item in model.inputs)]
    check_names(loaded, ("valid_range",), config.valid_range, places, "state or input", model)
    for key in ("withhold", "possible"):
        check_names(loaded, (key,), getattr(config, key), own, "state", model)
    check_named(loaded, ("watched",), config.watched or (), model)
    for name in () if field else model.state_names[len(own) :]:
        if name in config.prior:
            raise loaded.error(
                ("prior", name), "is considered, so its prior is the `std` of the parameter; give it there"
            )
    known = (model.states.name,) if isinstance(model.states, Field) else own
    check_names(loaded, ("prior",), config.prior, known, "field" if field else "state", model)
    check_names(loaded, ("noise",), config.noise, [item.name for item in model.noises], "noise", model)
    families = dict.fromkeys(sensor.family for sensor in model.sensors if sensor.family)
    check_names(loaded, ("sensors",), config.sensors, [*model.sensor_names, *families], "sensor", model)
    return replace(
        _with_noise(model, loaded),
        states=_states(model, loaded),
        inputs=_ranged(model.inputs, loaded),
        sensors=tuple(_sensor(sensor, loaded) for sensor in model.sensors),
    )


def _assembled(model: StateSpaceModel, loaded: Loaded) -> StateSpaceModel:
    """Return the model with the correction, coloured noise, sensor errors and joint parameters of the YAML."""
    config = loaded.config
    learned, learned_place = None, ""
    if config.correction is not None:
        make = maker("corrections", "file", f"{loaded.places.at(('correction',))}: correction", "learned")
        learned, learned_place = make(loaded, model, _beside(loaded, config.correction))
    noises = {
        name: section.correlation_time for name, section in config.noise.items() if section.correlation_time is not None
    }
    given = {name: section.error for name, section in config.sensors.items() if section.error is not None}
    known = [*(item.name for item in model.noises), *map(learned_noise, learned.corrects if learned else ())]
    check_names(loaded, ("noise",), noises, known, "noise", model)
    check_names(loaded, ("sensors",), given, model.sensor_names, "sensor", model)
    errors = {}
    for name, error in given.items():
        sensor = model.sensors[model.sensor_names.index(name)]
        variances = row_variances(loaded, ("sensors", name, "error"), error, sensor)
        errors[name] = ColouredError(variances, error.correlation_time)
    instruments = _instruments(model, loaded)
    sections = parameter_sections(model, config)
    values = {item.name: item.value for item in model.parameters}
    values |= {name: _value(name, section) for name, section in sections.items() if name not in values}
    values |= {disturbance_time(name): seconds for name, seconds in noises.items()}
    values |= {error_time(name): error.over for name, error in errors.items()}
    estimated = {}
    own: dict[str, Key] = {name: ("parameters", name) for name in sections} | _instrument_keys(config, instruments)
    for name, section in sections.items():
        std = section.spread(values[name])
        if std == 0.0 and section.std is not None:
            at: Key = (*own[name], "std")
            raise loaded.error(at, f"is {section.std} of {values[name]:g}; give it in the unit of the value")
        if std is not None:
            considered, widened = section.role == "considered", section.widened(values[name])
            estimated[name] = JointParameter(std, section.drift, considered, widened)
    for name, section in sections.items():
        check_names(loaded, ("parameters", name, "correlation"), section.correlation, list(values), "parameter", model)
        for other, value in section.correlation.items():
            mirrored = sections[other].correlation.get(name, value) if other in sections else value
            if name == other or mirrored != value:
                text = "is with itself" if name == other else f"is {value:g} here and {mirrored:g} under {other}"
                at = (*own[name], "correlation", other)
                raise loaded.error(at, f"{text}; give each pair once")
    if estimated and isinstance(model.states, Field):
        name = next(iter(estimated))
        raise loaded.error(
            own[name], f"is uncertain, and {model.name} is a field, whose parameters are held; give no std"
        )
    held = {name for name, section in sections.items() if section.role != "considered"}
    correlations = {
        (name, other): value
        for name, section in sections.items()
        for other, value in section.correlation.items()
        if not held & {name, other}
    }
    model = replace(model, states=_ranged(model.states, loaded), inputs=_ranged(model.inputs, loaded))
    try:
        return assemble(
            model,
            learned=learned,
            noises=noises,
            errors=errors,
            instruments={
                name: Instrument(
                    *(tuple(values[item] for item in parts if item.endswith(f"_{kind}")) for kind in Instrument._fields)
                )
                for name, parts in instruments.items()
            },
            estimated=estimated,
            correlations=correlations,
        )
    except AppendError as error:
        kind, name = error.part
        if kind == "learned":
            raise ConfigError(f"{learned_place}: {error}") from None
        keys = {
            "noise": ("noise", name, "correlation_time"),
            "error": ("sensors", name, "error"),
            "estimate": own.get(name, ()),
            "correlation": ("parameters",),
            "instrument": ("sensors" if name in config.sensors else "inputs", name),
        }
        raise ConfigError(f"{loaded.places.at(keys[kind])}: {dotted(keys[kind])}: {error}") from None


def _instruments(model: StateSpaceModel, loaded: Loaded) -> dict[str, dict[str, ParameterSection]]:
    """Return the sections of offsets and scales of the sensors and inputs that the model has."""
    config = loaded.config
    check_names(loaded, ("inputs",), config.inputs, [item.name for item in model.inputs], "input", model)
    given = {name for name, section in config.sensors.items() if any(getattr(section, k) for k in Instrument._fields)}
    check_names(loaded, ("sensors",), dict.fromkeys(given), model.sensor_names, "sensor", model)
    for name in config.inputs:
        if name in given:
            raise loaded.error(("inputs", name), "is a sensor's name too, whose offset or scale is given")
    found = instrument_sections(model, config)
    for item, key in _instrument_keys(config, found).items():
        section = found[str(key[1])][item]
        if key[2] == "scale" and not _value(item, section) > 0.0:
            turned = f"a sign belongs to the source, as in source.{key[0]}.{key[1]}: {{..., scale: -1}}"
            raise loaded.error(key, f"is {section.value:g}; it must be positive: {turned}")
        if not section.model_fields_set:
            raise loaded.error(key, "gives neither value nor std; add one")
    return found


def _instrument_keys(config: TwinSection, found: Mapping[str, Mapping[str, object]]) -> dict[str, Key]:
    """Return the keys at which the YAML has the offsets and scales, by their parameters."""
    return {
        item: ("inputs" if name in config.inputs else "sensors", name, item.rpartition("_")[2])
        for name, parts in found.items()
        for item in parts
    }


def _value(name: str, section: ParameterSection) -> float:
    """Return the value of an offset or a scale."""
    return section.value if section.value is not None else 1.0 if name.endswith("_scale") else 0.0


def _with_noise(model: StateSpaceModel, loaded: Loaded) -> StateSpaceModel:
    """Return the model with the YAML's variances of its process noises."""
    given = loaded.config.noise
    noises = (
        replace(noise, variance=given[noise.name].value) if noise.name in given else noise for noise in model.noises
    )
    return replace(model, noises=tuple(noises))


def physics_of(loaded: Loaded) -> StateSpaceModel:
    """Return the model with the YAML's parameters, before anything is appended."""
    return with_parameters(*expanded(find_model(loaded, ("model",), loaded.config.model), loaded))


def with_parameters(model: StateSpaceModel, loaded: Loaded) -> StateSpaceModel:
    """Return the model with the YAML's parameters in place of its own; raises as `configure`."""
    config = loaded.config
    names = [item.name for item in model.parameters]
    names += [item for parts in _instruments(model, loaded).values() for item in parts]
    times = [disturbance_time(name) for name, section in config.noise.items() if section.correlation_time is not None]
    times += [error_time(name) for name, section in config.sensors.items() if section.error is not None]
    for name in times:
        if name in config.parameters and config.parameters[name].value is not None:
            raise loaded.error(("parameters", name, "value"), "is a correlation time; give it as correlation_time")
    names += times
    check_names(loaded, ("parameters",), config.parameters, names, "parameter", model)
    values = {name: section.value for name, section in config.parameters.items() if section.value is not None}
    for item in model.parameters:
        value = values.get(item.name, item.value)
        if not item.low <= value <= item.high:
            raise loaded.error(
                ("parameters", item.name),
                f"is {value:g} {item.unit}; it must lie between {item.low:g} and {item.high:g}",
            )
    parameters = tuple(replace(p, value=values.get(p.name, p.value)) for p in model.parameters)
    return replace(model, parameters=parameters)


def _states(model: StateSpaceModel, loaded: Loaded) -> Sequence[State]:
    """Return the states with the YAML's prior; that of a field is given for all its cells, under the field's name."""
    given, cells = loaded.config.prior, loaded.config.view.cells
    states = model.states
    if cells is not None and model.grid is None:
        raise loaded.error(("view", "cells"), f"is for large fields; every state of {model.name} is kept; leave it out")
    if isinstance(states, Field):
        if cells is not None:
            check_named(loaded, ("view", "cells"), cells, model)
            states = replace(states, shown=tuple(model.state_names.index(name) for name in cells))
        prior = given.get(states.name)
        if prior is None:
            return states
        if prior.std == 0.0:
            raise loaded.error(
                ("prior", states.name, "std"),
                "is 0; that of a field must be positive, or its members would be alike",
            )
        means = states.means if prior.mean is None else ()
        return replace(states, means=means, **prior.model_dump(exclude_none=True))
    found = []
    for state in _ranged(states, loaded):
        prior = given.get(state.name, PriorSection())
        state = replace(
            state,
            **prior.model_dump(exclude_none=True),
            withhold=loaded.config.withhold.get(state.name, state.withhold),
            watched=state.name in (loaded.config.watched or (state.name,)),
        )
        found.append(replace(state, limits=_possible(state, loaded)))
    return tuple(found)


POSITIVE = ("K", "kg")
"""Units of quantities that are not negative. A difference of two may be, and has a prior about 0."""


def _possible(state: State, loaded: Loaded) -> tuple[float, float] | None:
    """Return the physical limits of a state: those of the YAML, else of the model, else of its unit.

    Raises:
        ConfigError: If a range of the YAML has no point within them, or the prior's mean lies beyond.
    """
    given, positive = loaded.config.possible.get(state.name), state.unit in POSITIVE and state.mean > 2.0 * state.std
    own = state.limits or ((0.0, inf) if positive else None)
    limits = own if given is None else bounds(given, own)
    for key, pair, other in (("possible", limits, own), ("valid_range", state.fitted, limits)):
        if pair and other and (pair[0] > other[1] or pair[1] < other[0]):
            text = f"is {_ends(pair, state)}, outside the physical limits, {_ends(other, state)}"
            raise loaded.error((key, state.name), f"{text}; give it in the unit of the state")
    if limits and not limits[0] <= state.mean <= limits[1]:
        at: Key = ("prior", state.name, "mean") if given is None else ("possible", state.name)
        text = f"does not fit: the prior has the mean {state.mean:g}, and possible is {_ends(limits, state)}"
        raise loaded.error(at, f"{text}; change one of them")
    return limits


def _ends(pair: tuple[float, float], state: State) -> str:
    return f"{pair[0]:g} to {pair[1]:g}{spaced(state.unit)}"


def _ranged(items: Any, loaded: Loaded) -> Any:
    """Return states or inputs with the YAML's ranges of validity; a field stays."""
    valid, widen = loaded.config.valid_range, [section.widen for section in loaded.config.parameters.values()]
    if isinstance(items, Field):
        return items
    found = (
        replace(item, far=max((own[item.name].per for own in widen if item.name in own), default=None))
        for item in items
    )
    return tuple(
        replace(item, fitted=bounds(own.range, item.fitted), near=own.extrapolate)
        if (own := valid.get(item.name))
        else item
        for item in found
    )


def _sensor(sensor: Sensor, loaded: Loaded) -> Sensor:
    section = loaded.config.sensors.get(sensor.name, SensorSection())
    if section.correlation is not None:
        sensor = replace(sensor, correlation=_correlation(sensor, section.correlation, loaded))
    if variances := row_variances(loaded, ("sensors", sensor.name), section, sensor):
        rows = tuple(replace(row, variance=variance) for row, variance in zip(sensor.rows, variances, strict=True))
        sensor = replace(sensor, rows=rows)
    by_chance = section.expected == "by chance" or sensor.by_chance and "expected" not in section.model_fields_set
    return replace(sensor, limits=limits_of(sensor, section, loaded), by_chance=by_chance)


def _correlation(sensor: Sensor, given: Correlation, loaded: Loaded) -> Correlation | None:
    """Return the correlation of a sensor's rows; None if they are independent."""
    wrong = correlation_error(given, len(sensor.rows))
    if wrong:
        raise loaded.error(("sensors", sensor.name, "correlation"), wrong)
    return None if np.array_equal(given, np.eye(len(given))) else given


MAX_STUCK_RUN = 1e6
"""Equal measurements after which a stuck sensor must be detected at the latest."""


def limits_of(sensor: Sensor, section: SensorSection, loaded: Loaded) -> Limits | None:
    """Return the sensor's limits, replaced by those of the YAML, with the ends of its signals by the DBC.

    Raises:
        ConfigError: With file and line, if a list does not fit the sensor's rows, or a rule can never apply.
    """
    own = sensor.limits or Limits()
    given = section.stuck
    stuck = own.stuck if given is None else Stuck(given.readings, given.seconds, given.quantum or (), given.std or ())
    limits = Limits(
        range=own.range if section.range is None else tuple(map(bounds, section.range)),
        saturation=own.saturation if section.saturation is None else tuple(map(bounds, section.saturation)),
        rate=section.rate or own.rate,
        stuck=stuck,
        duplicates=own.duplicates if section.duplicates is None else section.duplicates.within,
        rests=own.rests or section.rests,
        ends=own.ends or signal_ends(sensor, loaded),
    )
    wrong = limits.flaw(len(sensor.rows))
    if wrong is None:
        wrong = _contradiction(limits, sensor) or _too_long(limits, sensor, loaded.config)
    if wrong is not None:
        key, _, rule = wrong.partition(" ")
        raise loaded.error(("sensors", sensor.name, *key.split(".")), rule)
    return None if limits == Limits() else limits


def _contradiction(limits: Limits, sensor: Sensor) -> str | None:
    """Return limits that reject every measurement or never apply, as `key is ...; rule`; None if there are none."""
    for k, row in enumerate(sensor.rows):
        low, high = _of_row(limits.range, k, (-inf, inf))
        clip_low, clip_high = _of_row(limits.saturation, k, (-inf, inf))
        if not (low < clip_high and clip_low < high):
            return (
                f"saturation is {clip_low:g} to {clip_high:g} {row.unit}, and range is {low:g} to {high:g}: no reading "
                "keeps both; let them overlap"
            )
        width = min(high, clip_high) - max(low, clip_low)
        std = sqrt(row.variance)
        if width < std:
            key = "range" if limits.range else "saturation"
            return (
                f"{key} leaves {width:g} {row.unit}, less than the noise of the sensor ({std:g} {row.unit}), so that "
                "most valid measurements would be rejected; widen it"
            )
        stuck = limits.stuck
        if stuck is None:
            continue
        quantum = _of_row(stuck.quantum, k, 0.0)
        if quantum >= width:
            return (
                f"stuck.quantum is {quantum:g} {row.unit}; it must be below what the sensor can say, {width:g} "
                f"{row.unit}: give the step of its converter"
            )
        if stuck.readings is None and stuck.seconds is None:
            std = _of_row(stuck.std, k, std)
            if not std > 0.0:
                return "stuck gives a quantum alone, which needs a sensor with noise; add readings or seconds"
            if MAX_STUCK_RUN * surprise(quantum, std) < log(DAY):
                return (
                    f"stuck.quantum is {quantum:g} {row.unit}, so coarse that noise of {std:g} {row.unit} never moves "
                    "the reading; add readings or seconds"
                )
    return None


def _of_row(values: tuple[T, ...], k: int, default: T) -> T:
    """Return the entry of row k, from one for all rows or one a row."""
    return values[k % len(values)] if values else default


def _too_long(limits: Limits, sensor: Sensor, config: TwinSection) -> str | None:
    """Return a window of duplicates that would make every measurement a copy; None if it does not."""
    within, stale, period = limits.duplicates, config.time.stale_after, config.sensor_period(sensor.name)
    what = f"duplicates.within is {within:g} s"
    if period is not None and within >= period:
        return f"{what}; it must be below the sensor's period ({period:g} s), or its next reading counts as a copy"
    if within >= stale:
        return f"{what}; it must be below time.stale_after ({stale:g} s), as a sensor that stands still would be silent"
    return None
