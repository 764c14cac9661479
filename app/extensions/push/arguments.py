"""Arguments of `nisus push`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from app.cli.arguments import JsonOption


@dataclass(frozen=True)
class PushCommand(JsonOption):
    """Send lines of standard input, NDJSON or CSV with a heading, to a running twin of source type push.

    Examples:
      nisus push --time t --unit ms
      nisus push "http://127.0.0.1:9900/?token=TOKEN" --source plc
    """

    url: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="URL")] = None
    """Address of the twin, with its token, as `nisus run` printed it. Default: the environment variable NISUS_URL; a
    command line can be read by other users."""
    time: str | None = None
    """Column of a CSV with the time: ISO 8601 with an offset, or numbers. Default: the column time; without it, rows
    have the time of arrival."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of numbers in that column, since 1970."""
    source: str | None = None
    """Name of the sender. A line that was sent before under the same name is not taken twice. Default: a new one."""
