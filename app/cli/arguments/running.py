"""What of the command line runs a twin: a dataclass for each command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from .words import Settings, Twin


@dataclass(frozen=True)
class Run:
    """Run a twin, and show it in the browser; without a name, the gallery of all that ship."""

    twin: Annotated[str | None, tyro.conf.Positional] = None
    """Name of a twin that ships (see `nisus twins`), or path of a YAML file. Default: the gallery, to choose one."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable: Q.temperature=0.02, R.winding=9, p.NAME, use.SENSOR=false, gate, or a dotted YAML key."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    record: Path | None = None
    """Record into this .rrd file from the start."""
    record_split: str | None = None
    """Go on in another file, run-2.rrd after run.rrd, when one has grown so large or so long: 1GB, 10min."""
    speed: float | None = None
    """Speed of replays and simulations, as a multiple of real time; inf is as fast as possible. Default: the twin's."""
    duration: float | None = None
    """Stop after this many seconds."""
    port: int = 9900
    """Port of the page, on 127.0.0.1; 0 picks a free one."""
    recordings: Path = Path("recordings")
    """Folder of what the page records, lists, and is given by dropping it there; made when it is needed."""
    no_browser: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the URL without opening a browser."""
    headless: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run without a page; record if asked to."""


@dataclass(frozen=True)
class Review:
    """Open a recording on the page, with a panel that can fold its readings again."""

    file: Annotated[Path, tyro.conf.Positional]
    """The .rrd file."""
    port: int = 9900
    """Port of the page, on 127.0.0.1; 0 picks a free one."""
    recordings: Path = Path("recordings")
    """Folder of what the page records, lists, and is given by dropping it there; made when it is needed."""
    no_browser: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the URL without opening a browser."""
    duration: float | None = None
    """Stop after this many seconds."""


@dataclass(frozen=True)
class Bus:
    """Play a twin's asset on its CAN bus, in a process of its own."""

    twin: Twin
    """Name of a twin with a CAN source that has an `asset`, or path of a YAML file."""
    interface: str = "udp_multicast"
    """python-can's name of the bus: udp_multicast reaches other processes of this machine, socketcan a real bus."""
    channel: str | None = None
    """Channel of the interface; default: the twin's where it suits, else the interface's own."""
    set: Settings = ()
    """KEY=VALUE of the YAML, repeatable."""
    duration: float | None = None
    """Stop after this many seconds."""
    record: Path | None = None
    """Also write the frames to this log, in any format python-can writes (.blf, .asc, .log, .csv, .mf4)."""
