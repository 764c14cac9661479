"""What a twin's YAML says of a fit: the ranges of its noises, as a data sheet has them, and what to aim at."""

from __future__ import annotations

from config.schema import TwinSection
from config.source_schema import SimulatorSection
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


def natural_aim(config: TwinSection) -> str:
    """What a fit aims at if nobody says otherwise.

    What a recording knows of the truth was measured, to be learnt from. A simulated asset stands for one of which
    nobody knows the truth.
    """
    # With it come all folds, for which a twin that nobody fits need not wait.
    from estimators.fit.aims import LIKELIHOOD, WITNESSES

    return LIKELIHOOD if isinstance(config.source, SimulatorSection) else WITNESSES
