"""What was normal when a twin's tuning was accepted: `commissioned` of its YAML, checked against the model."""

from __future__ import annotations

import numpy as np

from config.loader import Loaded
from estimators.diagnostics.commission import Normal, baseline_of
from estimators.diagnostics.evidence import CAUSES
from estimators.model.state_space import StateSpaceModel


def baseline(loaded: Loaded, model: StateSpaceModel) -> np.ndarray | None:
    """The baseline of the bank of tests, or None if nothing was commissioned.

    Raises:
        ConfigError: With file and line, if it names what the model or the bank lacks.
    """
    given = loaded.config.commissioned
    for name, section in given.items():
        if name not in model.row_names:
            rows = ", ".join(model.row_names[:8])
            raise loaded.error(("commissioned", name), f"is no sensor row of {model.name}; it has {rows}")
        for cause in section.reached:
            if cause not in CAUSES:
                raise loaded.error(
                    ("commissioned", name, "reached", cause), f"is no cause; choose from {', '.join(CAUSES)}"
                )
    if not given:
        return None
    normals = {
        name: Normal(section.bias, section.scale, section.correlation, section.reached)
        for name, section in given.items()
    }
    return baseline_of(model, normals)
