"""Twins of a YAML text, and the line with which one is refused."""

from pathlib import Path

from app.twin.twin import Twin, load_twin
from estimators.errors import ConfigError, NisusError
from tests.support import error_of


def twin_of(text: str, **options: object) -> Twin:
    """The twin of a file `motor.yaml` in the working directory."""
    Path("motor.yaml").write_text(text)
    return load_twin("motor.yaml", **options)  # type: ignore[arg-type]


def refusal(text: str, kind: type[NisusError] = ConfigError, **options: object) -> str:
    """The one line with which a YAML text is refused."""
    return error_of(kind, twin_of, text, **options)
