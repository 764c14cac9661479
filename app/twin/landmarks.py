"""Expand the sections of a sensor with landmarks in a twin's YAML into sections of its members."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from config.channels import ChannelSection, SignalSection
from config.fields import ConditionSection
from config.loader import Loaded
from config.schema import SensorSection
from config.yaml_files import Key
from estimators.errors import ModelError
from estimators.model.landmarks import missing, with_landmarks
from estimators.model.state_space import StateSpaceModel

COLUMN = "landmark_column"


def expanded(model: StateSpaceModel, loaded: Loaded) -> tuple[StateSpaceModel, Loaded]:
    """Return a model with a sensor for each landmark, and the configuration of these.

    Raises:
        ConfigError: With file and line, if landmarks are missing or do not fit, or the column of a sensor's is.
    """
    sections = loaded.config.sensors.items()
    given = {name: section.landmarks for name, section in sections if section.landmarks is not None}
    for sensor in model.sensors:
        if sensor.place and sensor.name not in given:
            raise loaded.error(("sensors", sensor.name), missing(model, sensor).partition(f"{sensor.name} ")[2])
    if given:
        try:
            model = with_landmarks(model, given)
        except ModelError as error:
            raise loaded.error(("sensors", next(iter(given)), "landmarks"), f"does not fit: {error}") from None
    members: dict[str, list[str]] = {}
    for sensor in model.sensors:
        if sensor.family:
            members.setdefault(sensor.family, []).append(sensor.name)
    config = loaded.config
    sensors = dict(config.sensors)
    for family, names in members.items():
        if family in sensors:
            section = sensors.pop(family)
            common = section.model_copy(update={"landmarks": None})
            sensors |= {name: _merged(common, sensors.get(name)) for name in names}
            if section.landmarks is not None:  # stays for a YAML that is written from this one
                sensors[family] = SensorSection(landmarks=section.landmarks)
    source = _of_source(loaded, ("source",), config.source, members)
    scene = config.view.scene
    beacons = dict(scene.beacons)
    for family in beacons.keys() & members:
        east, north = beacons.pop(family)
        for name in members[family]:
            landmark = name.removeprefix(f"{family}_")
            beacons[name] = (east.replace("*", landmark), north.replace("*", landmark))
    view = config.view.model_copy(update={"scene": scene.model_copy(update={"beacons": beacons})})
    return model, replace(loaded, config=config.model_copy(update={"sensors": sensors, "source": source, "view": view}))


def _merged(common: SensorSection, own: SensorSection | None) -> SensorSection:
    """Return the section of a member: its own entries in place of those of the family."""
    if own is None:
        return common
    update: dict[str, object] = {name: getattr(own, name) for name in own.model_fields_set}
    if {"std", "variance"} & update.keys():
        update = {"std": None, "variance": None} | update
    return common.model_copy(update=update)


def _of_source(loaded: Loaded, key: Key, section: Any, members: Mapping[str, list[str]]) -> Any:
    """Return a section of the source, or of its parts or its asset, with channels or plans of the members."""
    update: dict[str, object] = {}
    if getattr(section, "parts", None):
        update["parts"] = tuple(
            _of_source(loaded, (*key, "parts", k), part, members) for k, part in enumerate(section.parts)
        )
    if getattr(section, "asset", None) is not None:
        update["asset"] = _of_source(loaded, (*key, "asset"), section.asset, members)
    sensors = dict(getattr(section, "sensors", {}))
    for name, item in list(sensors.items()):
        place = (*key, "sensors", name)
        by = getattr(item, COLUMN, None)
        if name not in members:
            if by is not None:
                raise loaded.error((*place, COLUMN), f"is for a sensor with landmarks, and {name} has none; use only")
            continue
        apart = isinstance(item, ChannelSection) and all("*" in column for column in item.names())
        if isinstance(item, ChannelSection) and by is None and not apart:
            rule = f"name the column that tells them apart, {COLUMN}: NAME, or columns of their own with * for the id"
            raise loaded.error(place, f"has landmarks; {rule}")
        del sensors[name]
        if by is not None:
            sensors |= _members(loaded, place, item, name, members[name])
        else:
            sensors |= {
                member: _with_id(item, member.removeprefix(f"{name}_")) if apart else item for member in members[name]
            }
    for group in ("inputs", "truth"):
        channels = getattr(section, group, {})
        for name, item in channels.items() if isinstance(channels, dict) else ():
            if getattr(item, COLUMN, None) is not None:
                raise loaded.error((*key, group, name, COLUMN), "is for a sensor with landmarks; use only")
    if sensors:
        update["sensors"] = sensors
    return section.model_copy(update=update)


def _members(loaded: Loaded, place: Key, item: ChannelSection, family: str, names: list[str]) -> dict[str, object]:
    """Return the channels of the members, which select the rows of their landmark."""
    ids = {name.removeprefix(f"{family}_"): name for name in names}
    if isinstance(item.landmark_column, str):
        column, rules = item.landmark_column, {landmark: _equals(landmark) for landmark in ids}
    else:
        named = item.landmark_column or {}
        if len(named) != 1:
            raise loaded.error((*place, COLUMN), f"names {len(named)} columns; name one")
        ((column, rules),) = named.items()
    unknown = [landmark for landmark in rules if landmark not in ids]
    if unknown:
        raise loaded.error((*place, COLUMN), f"names the landmark {unknown[0]!r}; {family} has {', '.join(ids)}")
    return {
        ids[landmark]: item.model_copy(update={COLUMN: None, "only": {**item.only, column: rule}})
        for landmark, rule in rules.items()
    }


def _with_id(item: ChannelSection, landmark: str) -> ChannelSection:
    """Return the channel of a member, whose columns or signals have its id in place of *."""
    named = "signals" if isinstance(item, SignalSection) else "columns"
    update: dict[str, object] = {named: tuple(name.replace("*", landmark) for name in item.names())}
    if isinstance(item, SignalSection):
        update["message"] = item.message.replace("*", landmark)
    return item.model_copy(update=update)


def _equals(landmark: str) -> ConditionSection:
    """Return the condition that a column holds an id, as a number if it is one."""
    try:
        number = float(landmark)
    except ValueError:
        return ConditionSection(text=(landmark,))
    return ConditionSection(range=(number, number))
