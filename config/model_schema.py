"""Schema of models that are not Python: matrices in a file, and those of extensions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Union

from pydantic import BeforeValidator, Discriminator, Field, Tag

from .extensions import schemas
from .fields import DurationOrZero, Section, Text, refused


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
    sample_time: DurationOrZero | None = None
    """Sample time in seconds, 0 for a continuous model. Default: that of the file, or 0."""
    states: Annotated[dict[Text, Text], Field(min_length=1)]
    """The states in the order of A, with their units: {position: m, speed: m/s}."""
    inputs: dict[Text, Text] = {}
    """The inputs in the order of B, with their units. Default: none."""
    sensors: Annotated[dict[Text, Text | dict[Text, Text]], Field(min_length=1)]
    """The sensors in the order of C, with the unit of their row, or the units of several rows by name:
    {gnss: {east: m, north: m}, odometer: m/s}."""


KINDS: dict[str, type[Section]] = {"matrices": MatricesSection} | schemas("models")
"""Sections of models by the key of their file."""


def kind_of(model: object) -> str:
    """Return the key of the file in a model, as a section or YAML; empty if it is a reference."""
    keys = model if isinstance(model, dict) else ()
    return next((key for key, kind in KINDS.items() if key in keys or isinstance(model, kind)), "")


def model_file(model: Model) -> str:
    """Return the file of a model, or its reference."""
    return model if isinstance(model, str) else str(getattr(model, kind_of(model)))


def _named(value: object) -> object:
    if isinstance(value, dict) and not kind_of(value):
        raise refused("no_kind", f"names {'neither' if len(KINDS) > 1 else 'no'} {' nor '.join(KINDS)}")
    return value


if TYPE_CHECKING:
    Model = str | Section
else:
    Model = Annotated[
        Union[Annotated[Text, Tag("as_")], *(Annotated[kind, Tag(f"as_{key}")] for key, kind in KINDS.items())],
        Discriminator(lambda value: f"as_{kind_of(value)}"),
        BeforeValidator(_named),
    ]
