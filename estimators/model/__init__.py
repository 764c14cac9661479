"""State-space models: their declaration and checks, and models assembled from others.

A model's file imports them: `from nisus import Row, Sensor, State, StateSpaceModel`.
"""

from .state_space import Field, Input, Jump, Limits, Noise, Parameter, Row, Sensor, State, StateSpaceModel, Stuck

__all__ = [
    "Field",
    "Input",
    "Jump",
    "Limits",
    "Noise",
    "Parameter",
    "Row",
    "Sensor",
    "State",
    "StateSpaceModel",
    "Stuck",
]
