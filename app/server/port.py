"""The one loopback port of the page."""

from __future__ import annotations

import os
import socket

from estimators.errors import ConfigError


def listen(port: int) -> socket.socket:
    """A socket that listens on 127.0.0.1; port 0 takes a free one.

    Raises:
        ConfigError: If the port cannot be had.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":
            # Else a port that was just given up stays taken for a minute.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or "is not a port"
        raise ConfigError(f"port {port}: {reason}; choose another with --port") from None
    listener.setblocking(False)
    return listener


def check_port(port: int) -> None:
    """Refuse a port that cannot be had, before anything is compiled for a page on it.

    Raises:
        ConfigError: As `listen` does.
    """
    listen(port).close()
