"""Arguments of `nisus fleet`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from app.cli.arguments import ArchiveOptions, EstimatorOption, Flag, JsonOption, TuningOption
from app.extensions.service.arguments import ServiceOptions


@dataclass(frozen=True)
class FleetCommand(JsonOption, ArchiveOptions, ServiceOptions, TuningOption, EstimatorOption):
    """Follow many assets of one twin, and show them in the browser: the worst health first, and the page of each.

    Examples:
      nisus fleet pumps.yaml
      nisus fleet pumps.yaml --headless --out pumps.parquet
    """

    fleet: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FLEET")]
    """YAML file of the fleet: its twin, assets and source."""
    headless: Flag = False
    """Run without a page, to the end of the source, and print the worst assets (--json: all, as JSON)."""
    out: Path | None = None
    """Write the table of all assets, worst first, to this .csv or .parquet file at the end."""
    worst: int = 10
    """Number of assets to print."""
    store: Path | None = None
    """Keep the state of the fleet in this file (in a folder: FLEET.store), with the position in the source, and
    continue from it after a restart or a kill."""
    archive: Path | None = field(default=None, kw_only=True)
    """Keep the measurements of push and mqtt in Parquet files in this folder, in a folder for each fleet, so that each
    asset has a page of its own; `nisus query` reads them."""
    recordings: Path = Path("recordings")
    """Folder of recordings, with a folder for each asset; created when needed."""
