"""Schema of models that are not Python: matrices in a file, and FMUs."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator, Discriminator, Field, Tag

from .fields import NotNegative, Seconds, Section, Text, refused


class MatrixKeysSection(Section):
    """Names of the matrices in their file."""

    A: Text = "A"
    """Dynamics (nx, nx). Default: A."""
    B: Text = "B"
    """Effect of the inputs (nx, nu); needed if there are inputs. Default: B."""
    C: Text = "C"
    """Rows of all sensors (ny, nx). Default: C."""
    D: Text = "D"
    """Direct effect of the inputs on the sensors (ny, nu); a file may lack it. Default: D."""
    dt: Text = "dt"
    """Sample time in seconds, 0 or absent for a continuous model. Default: dt."""


class MatricesSection(Section):
    """A linear model: dx/dt = A x + B u or, with a sample time, x⁺ = A x + B u, and y = C x + D u."""

    matrices: Text
    """File of the matrices beside this one: .mat (MATLAB up to v7.2) or .npz (NumPy)."""
    keys: MatrixKeysSection = MatrixKeysSection()
    """Their names in the file. Default: A, B, C, D and dt."""
    sample_time: NotNegative | None = None
    """Sample time in seconds, 0 for a continuous model. Default: that of the file, or 0."""
    states: Annotated[dict[Text, Text], Field(min_length=1)]
    """The states in the order of A, with their units: {position: m, speed: m/s}."""
    inputs: dict[Text, Text] = {}
    """The inputs in the order of B, with their units. Default: none."""
    sensors: Annotated[dict[Text, Text | dict[Text, Text]], Field(min_length=1)]
    """The sensors in the order of C, with the unit of their row, or the units of several rows by name:
    {gnss: {east: m, north: m}, odometer: m/s}."""

    @property
    def file(self) -> str:
        """File of the matrices."""
        return self.matrices


def variable_name(variable: str) -> str:
    """Return the name under which a variable of an FMU is known: `car.wheel[1].v` becomes `car_wheel_1_v`."""
    return re.sub(r"\W+", "_", variable).strip("_")


def as_variables(value: Any) -> Any:
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
    step: Seconds
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

    @property
    def file(self) -> str:
        """File of the FMU."""
        return self.fmu


def _kind(value: Any) -> str:
    if isinstance(value, (dict, MatricesSection, FmuSection)):
        return "as_matrices" if isinstance(value, MatricesSection) or "matrices" in value else "as_fmu"
    return "by_name"


def _named(value: Any) -> Any:
    if isinstance(value, dict) and not {"matrices", "fmu"} & value.keys():
        raise refused("absent", "names neither matrices nor fmu")
    return value


Model = Annotated[
    Annotated[Text, Tag("by_name")]
    | Annotated[MatricesSection, Tag("as_matrices")]
    | Annotated[FmuSection, Tag("as_fmu")],
    Discriminator(_kind),
    BeforeValidator(_named),
]
