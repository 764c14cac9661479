"""Arguments of `nisus serve`, and those of every service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.cli.arguments import ArchiveOptions


@dataclass(frozen=True, kw_only=True)
class ServiceOptions:
    """Options of a command that serves pages of several twins."""

    port: int = 9900
    """Port of the overview; 0 picks a free one."""
    host: str = "127.0.0.1"
    """IP address to listen on; any other than a loopback address needs --tokens."""
    public: str | None = None
    """Address at which a reverse proxy offers the service, https://HOST; needs --tokens."""
    tokens: Path | None = None
    """File of tokens for users and programs, a line NAME ROLE TOKEN each; roles are view, feed, tune and admin."""
    duration: float | None = None
    """Stop after this many seconds."""


@dataclass(frozen=True)
class ServeCommand(ArchiveOptions, ServiceOptions):
    """Run several twins as one service on one port: an overview, the worst health first, and the page of each.

    Each twin is a process of its own; if it ends, it is started again. An option is also taken from the environment:
    NISUS_SERVE_PORT=8080 is --port 8080, unless that is given.

    Examples:
      nisus serve pump.yaml fan.yaml --store /var/lib/nisus
      nisus serve twins/
      nisus serve twins/ --tokens tokens.txt --public https://twins.example.com
    """

    from_environment = True

    twins: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """YAML files, names of bundled twins, or one folder of YAML files, which is watched."""
    store: Path | None = None
    """Folder in which each twin keeps its state, TWIN.store, and continues from it after a restart or a kill."""
    recordings: Path = Path("recordings")
    """Folder of recordings, with a folder for each twin; created when needed."""
    log_format: Literal["text", "json"] = "text"
    """Form of the lines on standard error: notices of the twins, and processes that end."""
