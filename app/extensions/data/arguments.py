"""Arguments of `nisus data`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.cli.arguments import JsonOption


@dataclass(frozen=True)
class DataCommand(JsonOption):
    """List the recordings of the bundled twins, or download one.

    Its files are checked by SHA-256, converted, and kept in the folder NISUS_DATA or else in the user's cache.

    Examples:
      nisus data
      nisus data get road_car_rav4
      nisus data get motor_bench --file measures_v2.csv
    """

    action: Annotated[Literal["list", "get"], tyro.conf.Positional] = "list"
    """What to do."""
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = None
    """For `get`: name of a recording, or of a twin that reads it."""
    file: tuple[Path, ...] = ()
    """For `get`: files of the source, which are read instead of a download."""
