"""What of the command line lists, describes and begins: a dataclass for each command."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from .words import Files


@dataclass(frozen=True)
class Filters:
    """List the estimators: what they assume, their options, what they cost and when they fail."""

    twin: str | None = None
    """Name or YAML file of a twin: which filters apply to it, what they cost there, and why the others do not apply."""


@dataclass(frozen=True)
class Twins:
    """List the twins that ship, or describe one: what to expect of it, and how every filter scored."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Of a twin that ships, or path of a YAML file."""
    picture: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw its picture for the gallery from a fold of its log, or those of all: config/cards/NAME.svg, or NAME.svg
    beside any other YAML."""


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of a twin's YAML, for editors that complete and check."""

    out: Path | None = None
    """File; without it, standard output."""


@dataclass(frozen=True)
class Log:
    """List what recordings hold: buses, messages, signals or columns, with rates, spans and holes."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """CAN logs (MF4, BLF, ASC, TRC, candump, CSV, SQLite) or tables (CSV, Parquet, MATLAB, NumPy), in their order."""
    dbc: Files = ()
    """DBC file that names messages and signals, repeatable; FILE@BUS where it holds on one bus only."""
    time: str | None = None
    """Column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Its unit: s, ms, us, ns, min or h."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class New:
    """Write a working pair NAME.yaml and NAME.py to start a twin of your own from: a pump, or a recording's signals."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the twin."""
    folder: Path = field(default_factory=Path.cwd)
    """Folder to write to."""
    log: tuple[Path, ...] = ()
    """Recordings whose signals become its sensors."""
    dbc: Files = ()
    """DBC file of their frames, repeatable; FILE@BUS where it holds on one bus only."""
    signals: str = ""
    """A,B: signals (SIGNAL or MESSAGE.SIGNAL) or columns to take; default: those that vary most finely, at most 6."""
    time: str | None = None
    """Column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Its unit: s, ms, us, ns, min or h."""
