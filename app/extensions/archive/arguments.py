"""Arguments of `nisus query`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from app.cli.arguments import Flag, JsonOption


@dataclass(frozen=True)
class QueryCommand(JsonOption):
    """Query an archive with SQL of DuckDB: a view for each twin, by its name, and `archive` with the rows of all.

    Examples:
      nisus query archive "SELECT count(*) FROM archive"
      nisus query archive "SELECT health, count(*) FROM motor_can GROUP BY health" --csv
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the archive, as given to `nisus run --archive`."""
    sql: Annotated[str, tyro.conf.Positional]
    """SELECT statement. Columns are those of `nisus fold --out`, and twin, revision, row and archived_ns."""
    csv: Flag = False
    """Print the result as CSV."""
