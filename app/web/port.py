"""The one loopback port of the page."""

from __future__ import annotations

import errno
import os
import socket
from typing import NamedTuple

from estimators.errors import ConfigError


class Listening(NamedTuple):
    """Sockets that listen on one port; `localhost` says whether that name, too, leads to them and to no one else."""

    sockets: list[socket.socket]
    localhost: bool

    @property
    def port(self) -> int:
        """Theirs."""
        return int(self.sockets[0].getsockname()[1])

    def close(self) -> None:
        """Give the port up."""
        for listener in self.sockets:
            listener.close()


def listen(port: int) -> Listening:
    """Listen on 127.0.0.1, and on ::1 where there is one, as `localhost` may mean either; port 0 takes a free one.

    Raises:
        ConfigError: If the port cannot be had on 127.0.0.1.
    """
    try:
        first = _listener(socket.AF_INET, "127.0.0.1", port)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or "is not a port"
        raise ConfigError(f"port {port}: {reason}; choose another with --port") from None
    try:
        return Listening([first, _listener(socket.AF_INET6, "::1", first.getsockname()[1])], True)
    except OSError as error:
        return Listening([first], error.errno not in (errno.EADDRINUSE, errno.EACCES))


def _listener(family: socket.AddressFamily, host: str, port: int) -> socket.socket:
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":
            # Else a port that was just given up stays taken for a minute.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except BaseException:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def check_port(port: int) -> None:
    """Refuse a port that cannot be had, before anything is compiled for a page on it.

    Raises:
        ConfigError: As `listen` does.
    """
    listen(port).close()
