"""After how long without a reading a twin is degraded: as the YAML says, or as long as its model remembers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from config.schema import ParameterSection, TwinSection, as_width
from config.source_schema import SimulatorSection
from estimators.diagnostics.time_constants import MAX_STATES, jacobian, time_constants
from estimators.errors import EstimatorError, ModelError
from estimators.estimator import Estimator
from estimators.fold_checks import check_variances
from estimators.late import EVENT_S_PER_NUMBER, rewind_seconds
from estimators.model.coloured import disturbance_time, error_time
from estimators.model.instruments import Instrument, instrument_parameters
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import plain
from estimators.snapshots import Snapshots
from estimators.tuning import Tuning

MIN_DEGRADED_S = 3.0
"""Seconds: below this a reading that is a little late would be a dropout."""

MISSED_PERIODS = 3.0
"""Periods of the slowest sensor that must be missed, where they are known."""

KEPT = 4
"""Intervals in succession that make a rate."""


class DegradedAfter(NamedTuple):
    """Seconds without a reading after which the twin is degraded, and where they come from."""

    seconds: float
    reason: str


def degraded_after(
    config: TwinSection, model: StateSpaceModel, recorded: Callable[[], float | None] = lambda: None
) -> DegradedAfter:
    """Return the YAML's value; by default the slowest time constant of the model at its prior, within limits.

    `recorded` returns the longest `rhythm` of a sensor in a recording, None if it is not known.
    """
    section = config.time
    if section.degraded_after is not None:
        return DegradedAfter(section.degraded_after, "time.degraded_after")
    slowest = _slowest(model)
    period = config.sensor_period() or recorded()
    least = MIN_DEGRADED_S if period is None else max(MIN_DEGRADED_S, MISSED_PERIODS * period)
    if slowest is None:
        reason = "the model has no time constant (nothing in it decays), so "
        reason += "the least that makes sense" if least == MIN_DEGRADED_S else "three periods of the slowest sensor"
        seconds = least
    else:
        reason = f"the slowest time constant of the model, {slowest:.4g} s"
        seconds = max(slowest, least)
        if seconds > slowest:
            reason += f", is below {least:g} s" + (
                "" if least == MIN_DEGRADED_S else ", three periods of the slowest sensor"
            )
    limit = section.stale_after if "stale_after" in section.model_fields_set else max(section.stale_after, least)
    if seconds > limit:
        seconds, reason = limit, f"{reason}, and no later than time.stale_after"
    return DegradedAfter(float(seconds), reason)


def rhythm(t: np.ndarray) -> float:
    """Return the longest time between two measurements, at t (ns), that lasts for `KEPT` in succession, s.

    So a logger that changes its rate has the slower one, whereas a pause by itself is none. At least the median.
    """
    gaps = np.diff(t)
    lasting = sliding_window_view(gaps, min(KEPT, gaps.size)).min(axis=1)
    return float(max(lasting.max(), np.median(gaps))) / 1e9


def _slowest(model: StateSpaceModel) -> float | None:
    if model.black_box or model.nx > MAX_STATES:
        return None
    p, dt = model.default_parameters, min(model.max_step, 1.0)
    try:
        constants = time_constants(jacobian(model, model.prior_mean.copy(), model.default_inputs, p, dt), dt)
    except ModelError:
        return None
    return float(constants[0]) if constants.size else None


def driven_states(model: StateSpaceModel) -> tuple[int, ...]:
    """Return the indices of the states that inputs drive, directly or through others; all of a large model."""
    if model.black_box or model.nx > MAX_STATES:
        return tuple(range(model.nx))
    rng, p, dt = np.random.default_rng(0), model.default_parameters, min(1.0, model.max_step)
    x, moved = np.empty((2, 2, model.nx))
    x[:] = model.prior_mean + model.prior_std * rng.standard_normal(model.nx)
    # An input reaches the last state of a chain after as many steps.
    for _ in range(model.nx + 1):
        for k, u in enumerate(model.default_inputs + np.outer((0.0, 1.0), 0.5 + rng.random(model.nu))):
            plain(model.f)(x[k], u, p, dt, moved[k])
        x[:] = moved
    return tuple(np.flatnonzero(x[0] != x[1]).tolist())


def bounds_of(config: TwinSection, model: StateSpaceModel) -> dict[str, tuple[float, float]]:
    """Least and greatest variance by key: Q.NAME, and R of each row and of the sensor as a whole."""
    found = {f"Q.{name}": section.bounds for name, section in config.noise.items()}
    for sensor, start in zip(model.sensors, model.row_start, strict=True):
        section = config.sensors.get(sensor.name)
        if section is not None:
            rows = model.row_names[start : start + len(sensor.rows)]
            shared = [f"{sensor.family}{name.removeprefix(sensor.name)}" for name in rows if sensor.family]
            found |= {f"R.{name}": section.bounds for name in (sensor.name, *rows, *shared)}
    return {key: bounds for key, bounds in found.items() if bounds is not None}


def instrument_sections(model: StateSpaceModel, config: TwinSection) -> dict[str, dict[str, ParameterSection]]:
    """Return the sections of the parameters that offsets and scales become, by sensor or input.

    What `parameters` gives of such a parameter takes the place of the instrument's.
    """
    found: dict[str, dict[str, ParameterSection]] = {}
    for name, section in (*config.sensors.items(), *config.inputs.items()):
        for kind in Instrument._fields:
            given = getattr(section, kind)
            for item in instrument_parameters(model, name, kind) if given is not None else ():
                own = config.parameters.get(item)
                changes = {key: getattr(own, key) for key in own.model_fields_set} if own is not None else {}
                found.setdefault(name, {})[item] = given.model_copy(update=changes)
    return found


def parameter_sections(model: StateSpaceModel, config: TwinSection) -> dict[str, ParameterSection]:
    """Return the YAML's sections of parameters, those of offsets and scales included."""
    instruments = instrument_sections(model, config).values()
    return {**config.parameters, **{item: section for parts in instruments for item, section in parts.items()}}


TOLERANCE = 0.1  # Deviation of a fitted parameter without data and without a `std`, as a share of its value


def width_priors(config: TwinSection, model: StateSpaceModel, wanted: Sequence[str]) -> dict[str, float]:
    """Return the deviation without data of each parameter that a fit of `wanted` leaves uncertain, in its unit.

    They are those with a `std` in the YAML, its data-sheet width, and fitted ones, with `TOLERANCE` of their value.

    Args:
        config: The YAML.
        model: Its model, which considers none.
        wanted: Keys and groups of the fit.
    """
    times = {disturbance_time(noise.name) for noise in model.noises} | set(map(error_time, model.sensor_names))
    found, sections = {}, parameter_sections(model, config)
    for item in model.parameters:
        section = sections.get(item.name, ParameterSection())
        if item.name in times or section.role != "considered" or "role" in section.model_fields_set and not section.std:
            continue
        if section.std is not None:
            found[item.name] = as_width(item.value, section.std)
        elif {"p", f"p.{item.name}"} & set(wanted) and item.value:
            found[item.name] = TOLERANCE * abs(item.value)
    return found


def natural_aim(config: TwinSection) -> str:
    """Return the default objective of a fit.

    A measured true state of a recording is used. The true state of a simulated asset is not, since a real asset has
    none.
    """
    # With it come all folds, for which a twin that nobody fits need not wait.
    from estimators.fit.aims import LIKELIHOOD, WITNESSES

    return LIKELIHOOD if isinstance(config.source, SimulatorSection) else WITNESSES


class Late(NamedTuple):
    """Whether late readings are used when they come, with R inflated, and why; else the filter goes back."""

    inflate: bool
    reason: str


def late_policy(config: TwinSection, model: StateSpaceModel, estimator: Estimator, tuning: Tuning) -> Late:
    """Return the policy, with its arithmetic."""
    section = config.time
    if section.late != "auto":
        return Late(section.late == "inflate", f"time.late is {section.late}")
    options = estimator.complete_for(model, tuning.options)
    numbers = estimator.state_size(options, model.nx) + estimator.memory(options, model)
    events = Snapshots(8 * numbers).every
    seconds = rewind_seconds(numbers, events)
    sum_ = f"{events} events x {numbers:,} numbers x {EVENT_S_PER_NUMBER * 1e9:g} ns = {seconds:.2g} s to go back"
    if seconds <= section.late_allowed:
        return Late(False, f"{sum_}, allowed {section.late_allowed:g} s")
    try:
        check_variances(estimator, options)
    except EstimatorError as error:
        return Late(False, f"{sum_}, more than {section.late_allowed:g} s, but {error}")
    return Late(True, f"{sum_}, more than {section.late_allowed:g} s")
