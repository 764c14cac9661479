"""A server that answers byte by byte."""

import socketserver
import threading
from contextlib import suppress

import pytest

from app.extensions.alerts import mail, webhook


class Drip(socketserver.BaseRequestHandler):
    """Sends the `first` bytes of its server, then one by one, each in good time."""

    def handle(self):
        with suppress(OSError):
            self.request.sendall(self.server.first)
            for _ in range(1000):
                self.request.sendall(b"x")
                threading.Event().wait(0.01)
            self.request.sendall(b"\r\n\r\n")


@pytest.fixture
def dripping(monkeypatch):
    """dripping(first, late): the port of a server that answers byte by byte; 0.3 s are allowed, and the timer is late.

    With a late timer, the socket's own timeout ends a handshake.
    """
    for module in (mail, webhook):
        monkeypatch.setattr(module, "TIMEOUT_S", 0.3)
    timer = threading.Timer
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Drip) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def dripping(first, late):
            monkeypatch.setattr(webhook.threading, "Timer", lambda seconds, end: timer(seconds + late, end))
            server.first = first
            return server.server_address[1]

        yield dripping
        server.shutdown()
