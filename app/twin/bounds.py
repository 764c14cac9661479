"""The ranges that a twin's YAML leaves its noises: what a data sheet says, by the tuning's keys."""

from __future__ import annotations

from config.schema import TwinSection
from estimators.model.state_space import StateSpaceModel


def bounds_of(config: TwinSection, model: StateSpaceModel) -> dict[str, tuple[float, float]]:
    """Least and greatest variance by key: Q.NAME, and R of each row and of the sensor as a whole."""
    found = {f"Q.{name}": section.bounds for name, section in config.noise.items()}
    for sensor, start in zip(model.sensors, model.row_start, strict=True):
        section = config.sensors.get(sensor.name)
        if section is not None:
            rows = model.row_names[start : start + len(sensor.rows)]
            found |= {f"R.{name}": section.bounds for name in (sensor.name, *rows)}
    return {key: bounds for key, bounds in found.items() if bounds is not None}
