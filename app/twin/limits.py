"""The limits of a sensor as the twin's YAML says."""

from __future__ import annotations

from math import inf, log, sqrt
from typing import Any

from config.limits_schema import bounds
from config.loader import Loaded
from config.schema import SensorSection, TwinSection
from config.source_schema import AssetSection
from estimators.model.sensor import Limits, Stuck
from estimators.model.state_space import Sensor
from estimators.plausibility import DAY, surprise

MOST_READINGS = 1e6
"""Equal readings after which a sensor that is stuck must be found at the latest."""


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
    if wrong is None:
        wrong = _contradiction(limits, sensor) or _too_long(limits, sensor, loaded.config)
    if wrong is not None:
        key, _, rule = wrong.partition(" ")
        raise loaded.error(("sensors", sensor.name, *key.split(".")), rule)
    return None if limits == Limits() else limits


def _contradiction(limits: Limits, sensor: Sensor) -> str | None:
    """What limits leave no reading, or could never speak, as `key is ...; rule`; None if they can be kept."""
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
                "most good readings would be refused; widen it"
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
                return (
                    "stuck gives a quantum alone, which says nothing of a sensor without noise; add readings or seconds"
                )
            if MOST_READINGS * surprise(quantum, std) < log(DAY):
                return (
                    f"stuck.quantum is {quantum:g} {row.unit}, so coarse that noise of {std:g} {row.unit} never moves "
                    "the reading; add readings or seconds"
                )
    return None


def _of_row(values: tuple[Any, ...], k: int, default: Any) -> Any:
    """The entry of row k among one for all rows, or one a row."""
    return values[k % len(values)] if values else default


def _too_long(limits: Limits, sensor: Sensor, config: TwinSection) -> str | None:
    """A window of duplicates that takes every reading for the one before."""
    within, stale = limits.duplicates, config.time.stale_after
    what = f"duplicates.within is {within:g} s"
    period = _period(sensor, config)
    if period is not None and within >= period:
        return f"{what}; it must be below the sensor's period ({period:g} s), or its next reading counts as a copy"
    if within >= stale:
        return f"{what}; it must be below time.stale_after ({stale:g} s), as a sensor that stands still would be silent"
    return None


def _period(sensor: Sensor, config: TwinSection) -> float | None:
    """Seconds between two readings of a sensor, where a simulated asset says so."""
    source = config.source
    asset = source if isinstance(source, AssetSection) else getattr(source, "asset", None)
    if asset is None:
        return None
    plan = asset.sensors.get(sensor.name)
    return float(asset.step * (1 if plan is None else plan.every))
