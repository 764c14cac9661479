"""A twin's simulated asset: its section checked against the model, and made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from config.loader import Loaded
from config.source_schema import AssetSection, ProfileSection
from config.yaml_files import Key, dotted
from estimators.model.state_space import StateSpaceModel

from ..channels import read_faults
from ..checks import check_names, row_variances
from ..defaults import parameter_sections
from ..model import find_model
from .kind import Kind, Opening

if TYPE_CHECKING:
    from sources.simulator import Profile, Simulator
    from sources.source import Source

MAX_SIMULATED_EVENTS = 1e8
"""The most events that a simulation may produce; it makes some ten thousand a second."""

ENDLESS_SPAN_S = 100.0
"""Seconds within which a simulation without end may produce that many."""


def make_asset(loaded: Loaded, model: StateSpaceModel, section: AssetSection, key: Key) -> Simulator:
    """Return the simulated asset.

    Raises:
        ConfigError: With file and line, if its true model does not fit the twin's.
    """
    from sources.simulator import SensorPlan, Simulator

    truth = section.truth
    moved = {name: truth.parameters[name] for name in _estimated(loaded, section, model)}
    truth_model = find_model(loaded, (*key, "truth", "model"), truth.model) if truth.model else None
    if truth_model is not None:
        _check_same(loaded, (*key, "truth", "model"), truth_model, model)
        _check_truth(loaded, section, key, truth_model)
    plans = {}
    for sensor in model.sensors:
        plan = section.sensors.get(sensor.name)
        if plan is None:
            continue
        variances = row_variances(loaded, (*key, "sensors", sensor.name), plan, sensor) or None
        plans[sensor.name] = SensorPlan(every=plan.every, variances=variances, drop_every=plan.drop_every)
    return Simulator(
        model,
        seed=section.seed,
        step=section.step,
        duration=section.duration,
        initial={**section.initial, **moved},
        truth_parameters={name: value for name, value in truth.parameters.items() if name not in moved},
        truth_model=truth_model,
        truth_noise={**dict.fromkeys(moved, 0.0), **{name: level.value for name, level in truth.noise.items()}},
        inputs={name: _profile(profiles) for name, profiles in section.inputs.items()},
        sensors=plans,
        truth_every=truth.every if model.grid is not None else None,
    )


def check_asset(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    """Refuse what names what the model lacks, or would never end.

    Raises:
        ConfigError: With file and line.
    """
    check_names(loaded, (*key, "initial"), section.initial, model.state_names, "state", model)
    check_names(loaded, (*key, "inputs"), section.inputs, model.input_names, "input", model)
    check_names(loaded, (*key, "sensors"), section.sensors, model.sensor_names, "sensor", model)
    read_faults(loaded, section.faults, (*key, "faults"), model)
    _check_length(loaded, section, key, model)
    if section.truth.model is None:
        _check_truth(loaded, section, key, model)


def _check_length(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    """Refuse a simulation that would not end, or not get on, in a person's time."""
    step, duration = section.step, section.duration
    seconds = max(ENDLESS_SPAN_S, step) if duration is None else max(duration, step)
    plans = [section.sensors.get(sensor.name) for sensor in model.sensors]
    readings = sum(1.0 / (plan.every if plan else 1) for plan in plans)
    runs = max(1.0, step / model.max_step)
    count = seconds / step * max(runs, readings)
    if count <= MAX_SIMULATED_EVENTS:
        return
    other = dotted((*key, "duration"))
    if duration is None:
        name, value, remedy = "step", step, "shorten it" if runs > readings else "lengthen it"
    elif step < 1.0 / duration:
        name, value, remedy = "step", step, f"lengthen it, or shorten {other}"
    else:
        name, value, remedy = "duration", duration, f"shorten it, or lengthen {dotted((*key, 'step'))}"
    raise loaded.error(
        (*key, name),
        f"is {value:g} s; the simulator would make {count:.3g} {'steps of f' if runs > readings else 'events'} in "
        f"{seconds:g} s, and may make {MAX_SIMULATED_EVENTS:.0e}; {remedy}",
    )


def _check_truth(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    """`model` is the asset's: the twin's own, or truth.model."""
    truth = section.truth
    parameters, noises = [item.name for item in model.parameters], [item.name for item in model.noises]
    moved = _estimated(loaded, section, model)
    check_names(loaded, (*key, "truth", "parameters"), truth.parameters, [*parameters, *moved], "parameter", model)
    for name in moved:
        if name in section.initial:
            raise loaded.error((*key, "initial", name), f"is in {dotted((*key, 'truth'))} too; give it in one place")
    check_names(loaded, (*key, "truth", "noise"), truth.noise, noises, "noise", model)


def _estimated(loaded: Loaded, section: AssetSection, model: StateSpaceModel) -> list[str]:
    """Return the names of true parameters that the twin estimates: states of `model`, constant in the asset."""
    if section.truth.model is not None:
        return []
    sections = parameter_sections(model, loaded.config)
    joint = {name for name, item in sections.items() if item.role == "estimated"}
    return [name for name in section.truth.parameters if name in joint and name in model.state_names]


def _check_same(loaded: Loaded, key: Key, truth: StateSpaceModel, model: StateSpaceModel) -> None:
    for what in ("state_names", "input_names", "row_names"):
        theirs, ours = getattr(truth, what), getattr(model, what)
        if theirs != ours:
            raise loaded.error(
                key, f"has {what.replace('_names', 's')} {', '.join(theirs)}; they must be {', '.join(ours)}"
            )


def _profile(sections: tuple[ProfileSection, ...]) -> Profile:
    """Return the sum of an input's profiles."""
    from sources.simulator import constant_input, sine_input, stepped_input, summed_inputs

    parts: list[Profile] = []
    for section in sections:
        if section.steps is not None:
            times, values = zip(*section.steps, strict=True)
            parts.append(stepped_input(times, values, section.repeat))
        elif section.sine is not None:
            sine = section.sine
            parts.append(sine_input(sine.mean, sine.amplitude, sine.period, sine.phase))
        else:
            parts.append(constant_input(section.constant or 0.0))
    return parts[0] if len(parts) == 1 else summed_inputs(tuple(parts))


def _open(opening: Opening) -> Source:
    return make_asset(opening.loaded, opening.model, opening.section, opening.key)


SIMULATOR = Kind(
    _open,
    check=lambda loaded, model, section, key: check_asset(loaded, section, key, model),
    sections=lambda section, key: {},
    takes_log=False,
)
