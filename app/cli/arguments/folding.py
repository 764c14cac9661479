"""What of the command line folds logs and measures what came of it: a dataclass for each command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from .words import Files, Settings, Twin


@dataclass(frozen=True)
class Fold:
    """Fold a twin's readings as fast as possible, and print what the estimate was worth."""

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    out: Path | None = None
    """Write the track to this .csv or .parquet, or a recording to this .rrd."""
    html: Path | None = None
    """Write a report to this HTML file, which needs no other: scores, charts, checks, episodes, tuning."""
    smooth: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Smooth too: what the readings before and after each moment say of it; a .csv or .parquet has it beside."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class Check:
    """Say what could be wrong with a twin unnoticed: a checklist with measured figures, on one page.

    Linearity, size, shape of the posterior, observability, the smallest visible fault of every sensor, input and
    parameter, how wrong each state can be by one that nobody sees, timing, health, and every sensor held out in turn
    beside the model without any reading.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""
    html: Path | None = None
    """Also write the page to this HTML file, which needs no other."""


@dataclass(frozen=True)
class Advise:
    """Say which estimator a twin needs, by what its log shows; or draft a twin of a recording that has none.

    Of a twin: the simplest estimator whose assumptions the recorded data pass, each claim with the figure that made it,
    and the lines for its YAML. Of a recording: rates, holes, noise, which signals say the same, what drives what.
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """A twin that ships, or the path of a YAML file; or recordings."""
    estimator: str | None = None
    """Estimator to start from instead of the twin's own."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the twin's source."""
    dbc: Files = ()
    """Of recordings: DBC file of their frames, repeatable; FILE@BUS where it holds on one bus only."""
    signals: str = ""
    """Of recordings: A,B, the signals to take, as for `new`."""
    time: str | None = None
    """Of recordings: column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Of recordings: its unit: s, ms, us, ns, min or h."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""
    apply: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put the lines into the twin's YAML; the file as it was is kept beside it."""
    out: Path | None = None
    """Write the YAML with the lines in it to this file, in the same folder if it names files beside it; of recordings
    write the draft, NAME.yaml and NAME.py."""


@dataclass(frozen=True)
class Compare:
    """Fold every filter that applies over the same log, in parallel, and print what each estimate was worth.

    A filter that draws its members folds eight times, with another seed each; its figures are mean ± standard
    deviation of one fold. A step is one event of the log; its cost is that of one processor.
    """

    twin: Twin
    """Name of a twin that ships, path of a YAML file, or `all`: each that ships."""
    estimators: tuple[str, ...] = ()
    """Compare only these filters."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    logs: int = 1
    """Number of logs of a simulated twin, with consecutive seeds; figures are mean ± standard deviation over them."""
    budget: float = 20.0
    """CPU seconds allowed for one filter; a slower filter folds a shorter span, which its row states."""
    jobs: int | None = None
    """Number of processes; default: one for each processor."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON list."""
    write: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the table as CSV: config/scores/NAME.csv for a twin that ships, NAME.scores.csv beside any other YAML."""


@dataclass(frozen=True)
class Stress:
    """Make mistakes with a twin on purpose, and print how soon, and how rightly, it says so.

    Errors of the tuning hold from the start; faults of what the source says from a third to two thirds of the log, so
    that false alarms before and recovery after them show too. Figures are medians over the seeds.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimators: tuple[str, ...] = ()
    """The filters to try. Default: the twin's own."""
    only: tuple[str, ...] = ()
    """Only mistakes whose name holds one of these texts."""
    list: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """List the mistakes, and make none."""
    seeds: int = 3
    """Number of seeds, of the simulated asset, the faults and the filter."""
    duration: float = 600.0
    """Seconds of the log."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON list, an object for each mistake, filter and seed."""
