"""Schema of models in FMUs."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator, Field

from config.fields import Duration, Section, Text


def variable_name(variable: str) -> str:
    """Return the name under which a variable of an FMU is known: `car.wheel[1].v` becomes `car_wheel_1_v`."""
    return re.sub(r"\W+", "_", variable).strip("_")


def as_variables(value: object) -> object:
    """Return a list of variables as {name: variable}."""
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        return {variable_name(item): item for item in value}
    return value


Variables = Annotated[
    dict[Text, Text], BeforeValidator(as_variables, json_schema_input_type=dict[Text, Text] | list[Text])
]


class FmuSection(Section):
    """A model in an FMU for model exchange (FMI 2 or 3). It runs as native code with the rights of the user."""

    fmu: Text
    """The FMU beside this file."""
    step: Duration
    """Longest step of the integration (Runge-Kutta of fourth order), s. Choose a tenth of the fastest time constant."""
    states: Variables = {}
    """Names of continuous states, {speed: der_pos} or a list of variables. Default: the variables' own names, with
    letters, digits and _ only; all continuous states are states."""
    inputs: Variables | None = None
    """Variables that are inputs, {name: variable} or a list. Default: all real inputs of the FMU."""
    parameters: Variables = {}
    """Real parameters that may be set or tuned, {name: variable} or a list. Default: none, they keep their start
    values."""
    sensors: Annotated[dict[Text, Text | dict[Text, Text]], Field(min_length=1)] | None = None
    """Measured variables: {sensor: variable}, or {sensor: {row: variable}} for several rows. Default: each real output
    of the FMU is a sensor."""
    units: dict[Text, Text] = {}
    """Units by variable of the FMU where its description has none. Default: those of the description, or 1."""
