"""Arguments of `nisus export`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from app.cli.arguments import Flag, FoldOptions, JsonOption


@dataclass(frozen=True)
class ExportCommand(JsonOption, FoldOptions):
    """Write the filter of a twin as C99 for a controller, with a test on the twin's own log.

    kf, kf-steady and ekf of models of up to 32 states, without allocation. The test compares the C code with the fold.

    Examples:
      nisus export motor_winding --c
      nisus export motor_can --c --out firmware --duration 60
    """

    c: Flag = False
    """Write NAME.h, NAME.c, NAME_test.c and NAME_vectors.csv."""
    out: Path = field(default_factory=Path.cwd)
    """Folder to write to; it is created if needed."""
    events: int = 2000
    """Largest number of measurements and inputs in the test."""
