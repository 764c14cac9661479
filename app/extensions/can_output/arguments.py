"""Arguments of `nisus bus`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from app.cli.arguments import JsonOption, Repeated, Twin


@dataclass(frozen=True)
class BusCommand(JsonOption):
    """Simulate the asset of a twin on a CAN bus.

    Examples:
      nisus bus motor_can
      nisus bus motor_can --interface virtual --record drive.blf --duration 60
    """

    twin: Twin
    """Name of a bundled twin with a CAN source and an `asset`, or path to a YAML file."""
    interface: str = "udp_multicast"
    """Interface of python-can: udp_multicast reaches other processes on this machine, socketcan a real bus."""
    channel: str | None = None
    """Channel of the interface. Default: the twin's if it fits, else the interface's own."""
    set: Repeated = ()
    """KEY=VALUE of the YAML, repeatable."""
    duration: float | None = None
    """Stop after this many seconds."""
    record: Path | None = None
    """Also write the frames to this log (.blf, .asc, .log, .csv, .mf4, .trc)."""
