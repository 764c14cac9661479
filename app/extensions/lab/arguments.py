"""Arguments of `nisus guard` and `nisus stress`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from app.cli.arguments import Flag, JsonOption, Repeated, TuningOption, Twin, WorkersOption


@dataclass(frozen=True)
class GuardCommand(JsonOption, WorkersOption):
    """Fold archived recordings with the accepted tunings of their twins and list figures that got worse.

    Without a name: the bundled twins with their bundled logs and those on this machine. A figure is worse if it
    changed by more than chance and by more than is negligible. Exit status: 0 if nothing got worse, 1 if something
    did, 2 if a recording could not be folded. Missing recordings are reported; with CI=true they are errors.

    Examples:
      nisus guard
      nisus guard motor_can --accept --note "new drive"
    """

    twins: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of bundled twins, or paths to YAML files."""
    archive: Path | None = None
    """Folder of recordings (.rrd) and twins (.yaml) to guard."""
    junit: Path | None = None
    """Also write the verdict to this file as JUnit XML."""
    accept: Flag = False
    """Record the present figures as the baseline."""
    note: str = ""
    """Reason for --accept, saved with the baseline."""
    set: Repeated = ()
    """KEY=VALUE, repeatable; see `nisus run --help`. Shows the figures under another setting."""


@dataclass(frozen=True)
class StressCommand(JsonOption, WorkersOption, TuningOption):
    """Inject faults into a twin and print how soon and how correctly they are detected.

    Tuning errors hold from the start. Sensor faults hold from one third to two thirds of the log, to show false alarms
    before them and recovery after them. Figures are medians over the seeds.

    Examples:
      nisus stress motor_winding --list
      nisus stress motor_winding --only winding --seeds 1
    """

    twin: Twin
    """Name of a bundled twin, or path to a YAML file."""
    estimators: tuple[str, ...] = ()
    """Filters to test. Default: the twin's own."""
    only: tuple[str, ...] = ()
    """Only faults whose name contains one of these texts."""
    list: Flag = False
    """List the faults without folding."""
    seeds: int = 3
    """Number of seeds for simulator, faults and filter."""
    duration: float = 600.0
    """Seconds of the log."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
