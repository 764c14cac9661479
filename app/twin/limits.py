"""The limits of a sensor as the twin's YAML says."""

from __future__ import annotations

from config.limits_schema import bounds
from config.loader import Loaded
from config.schema import SensorSection
from estimators.model.limits import Limits, Stuck
from estimators.model.state_space import Sensor


def limits_of(sensor: Sensor, section: SensorSection, loaded: Loaded) -> Limits | None:
    """The sensor's own limits with those of its YAML in their place.

    Raises:
        ConfigError: With file and line, if a list does not fit the sensor's rows, or a rule could never speak.
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
    )
    wrong = limits.flaw(len(sensor.rows))
    if wrong is not None:
        key, _, rule = wrong.partition(" ")
        raise loaded.error(("sensors", sensor.name, *key.split(".")), rule)
    if stuck is not None and stuck.readings is None and stuck.seconds is None and not stuck.std:
        if not all(row.variance > 0 for row in sensor.rows):
            raise loaded.error(
                ("sensors", sensor.name, "stuck"),
                "gives a quantum alone, which says nothing of a sensor without noise; add readings or seconds",
            )
    return None if limits == Limits() else limits
