"""Checks of a twin's YAML against its model: names, scene, baseline and dual estimation."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

from config.fields import VarianceSection
from config.loader import Loaded
from config.schema import PriorSection, SensorSection
from config.yaml_files import Key
from estimators.diagnostics.detectors import ALARM_NAMES, CAUSES
from estimators.diagnostics.episodes.baseline import Normal
from estimators.errors import ConfigError, nearest
from estimators.fit.entries import check_key
from estimators.model.state_space import Sensor, StateSpaceModel
from estimators.tuning import Tuning


def commissioned(loaded: Loaded, model: StateSpaceModel) -> dict[str, Normal]:
    """Return the baseline by sensor row; empty if none was recorded.

    Raises:
        ConfigError: With file and line, if it names what the model or the bank lacks.
    """
    given = loaded.config.baseline
    check_names(loaded, ("baseline",), given, model.row_names, "sensor row", model)
    for name, section in given.items():
        check_names(loaded, ("baseline", name, "reached"), section.reached, ALARM_NAMES, "alarm", model)
    return {
        name: Normal(section.bias, section.scale, section.correlation, section.reached, section.nis, section.forced)
        for name, section in given.items()
    }


def check_scene(loaded: Loaded, model: StateSpaceModel) -> None:
    """Refuse a scene that names what the model does not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    scene = loaded.config.view.scene
    for key in ("axes", "position", "heading", "parts", "charge", "temperature", "states"):
        value = getattr(scene, key) or ()
        names = (value,) if isinstance(value, str) else tuple(value.values()) if isinstance(value, dict) else value
        check_named(loaded, ("view", "scene", key), names, model)
    rows = {sensor.name: len(sensor.rows) for sensor in model.sensors}
    for key in ("beams", "beacons"):
        _check_names(loaded, ("view", "scene", key), getattr(scene, key), rows, f"sensor of {model.name}")
    for name, angles in scene.beams.items():
        if len(angles) != rows[name]:
            text = f"has {len(angles)} angles; {name} has {rows[name]} rows, give one for each"
            raise loaded.error(("view", "scene", "beams", name), text)
    for name, place in scene.beacons.items():
        at = ("view", "scene", "beacons", name)
        if rows[name] != 1:
            raise loaded.error(at, f"is for one distance; {name} has {rows[name]} rows")
        known = (*estimated_names(model), *(parameter.name for parameter in model.parameters))
        _check_names(loaded, at, place, known, f"state or parameter of {model.name}")


def check_stated(loaded: Loaded, model: StateSpaceModel, source: str) -> None:
    """Refuse a YAML without the prior, process noise or sensor noise of a model whose `source` has no statistics.

    Raises:
        ConfigError: With file and line.
    """
    config = loaded.config
    prior, sensors = PriorSection(), SensorSection()
    lacking = [("prior", name) for name in model.state_names if config.prior.get(name, prior).std is None]
    lacking += [("sensors", name) for name in model.sensor_names if config.sensors.get(name, sensors).variances is None]
    for key, name in lacking:
        raise loaded.error((key,), f"has no std of {name}, and {source} has none; give {name}: {{std}}")
    if not config.noise:
        example = model.state_names[-1]
        raise loaded.error(("noise",), f"is missing, and {source} has none; give for example {example}: {{std}}")


def row_variances(loaded: Loaded, key: Key, section: VarianceSection, sensor: Sensor) -> tuple[float, ...]:
    """Return the variance of each row of a sensor, from one for all or one each; none if the section gives none."""
    values, rows = section.variances or (), [row.name for row in sensor.rows]
    if len(values) == 1:
        return values * len(rows)
    if values and len(values) != len(rows):
        place = (*key, "std" if section.std is not None else "variance")
        raise loaded.error(place, f"has {len(values)} entries; give one, or {len(rows)}: {', '.join(rows)}")
    return values


def check_names(
    loaded: Loaded, key: Key, given: Iterable[str], known: Collection[str], kind: str, model: StateSpaceModel
) -> None:
    """Refuse a name under `key` that the model does not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    for name in given:
        if name not in known:
            raise loaded.error((*key, name), f"is no {kind} of {model.name}; {nearest(name, known)}")


def estimated_names(model: StateSpaceModel) -> Sequence[str]:
    """Return the names of the states without those of considered parameters, which are named in no YAML."""
    names = model.state_names
    return names[: model.nx - model.considered] if model.considered else names


def check_named(loaded: Loaded, key: Key, names: Iterable[str], model: StateSpaceModel) -> None:
    """Refuse a state that the value at `key` names and the model does not estimate.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    _check_names(loaded, key, names, estimated_names(model), f"state of {model.name}")


def check_refit(loaded: Loaded, estimator: str, tuning: Tuning) -> None:
    """Refuse entries that cannot be fitted beside the running twin.

    Raises:
        ConfigError: With file and line.
    """
    section = loaded.config.refit
    if section is None:
        return
    if tuning.model.black_box:
        raise loaded.error(("refit",), f"{tuning.model.name} is a black box, too slow for it; use nisus tune --windows")
    for name in section.entries:
        group, _, rest = name.partition(".")
        if group == "prior":
            raise loaded.error(("refit", "entries"), f"names {name}; a window begins where the filter is, not there")
        if group == "p" and rest in tuning.model.state_names:
            text = f"names {name}, which `role: estimated` moves into the state; keep it in one of them"
            raise loaded.error(("refit", "entries"), text)
        try:
            check_key(estimator, tuning, name)
        except ConfigError as error:
            raise loaded.error(("refit", "entries"), f"names {name}: {error}") from None


def check_outputs(loaded: Loaded, model: StateSpaceModel) -> None:
    """Refuse rules of alerts that name what model, guide or receivers do not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    outputs, states = loaded.config.outputs, [state.name for state in model.shown_states]
    check_receivers(loaded, outputs, loaded.config.alerts)
    for k, rule in enumerate(loaded.config.alerts):
        for key, given, known, kind in (
            ("state", (rule.state,) if rule.state else (), states, f"state of {model.name}"),
            ("episode", rule.episode or (), ("all", *CAUSES), "cause of an episode"),
        ):
            _check_names(loaded, ("alerts", k, key), given, known, kind)


def check_receivers(loaded: Loaded, outputs: Any, rules: Sequence[Any]) -> None:
    """Refuse rules of alerts, of a twin or a fleet, that name no receiver.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    for name, section in outputs.receivers.items():
        if getattr(outputs, section.type, section) is None:
            text = f"is of type {section.type}; give the broker under outputs.{section.type}"
            raise loaded.error(("outputs", "receivers", name), text)
    for k, rule in enumerate(rules):
        receivers = tuple(outputs.receivers)
        _check_names(loaded, ("alerts", k, "to"), rule.to or (), receivers, "receiver under outputs.receivers")
        if not receivers:
            raise loaded.error(("alerts", k), "has no receiver; name one under outputs.receivers")


def _check_names(loaded: Loaded, key: Key, given: Iterable[str], known: Collection[str], kind: str) -> None:
    for name in given:
        if name not in known:
            raise loaded.error(key, f"names {name!r}, no {kind}; {nearest(name, known)}")
