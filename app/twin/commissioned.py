"""What was normal when a twin's tuning was accepted: `commissioned` of its YAML, checked against the model."""

from __future__ import annotations

from config.loader import Loaded
from estimators.diagnostics.commission import Normal
from estimators.diagnostics.detectors import ALARM_NAMES
from estimators.model.state_space import StateSpaceModel


def commissioned(loaded: Loaded, model: StateSpaceModel) -> dict[str, Normal]:
    """What was normal by sensor row; nothing if nothing was commissioned.

    Raises:
        ConfigError: With file and line, if it names what the model or the bank lacks.
    """
    given = loaded.config.commissioned
    for name, section in given.items():
        if name not in model.row_names:
            rows = ", ".join(model.row_names[:8])
            raise loaded.error(("commissioned", name), f"is no sensor row of {model.name}; it has {rows}")
        for cause in section.reached:
            if cause not in ALARM_NAMES:
                raise loaded.error(
                    ("commissioned", name, "reached", cause), f"is no cause; choose from {', '.join(ALARM_NAMES)}"
                )
    return {
        name: Normal(section.bias, section.scale, section.correlation, section.reached, section.nis)
        for name, section in given.items()
    }
