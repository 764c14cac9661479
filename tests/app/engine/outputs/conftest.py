"""Servers to which alerts are sent."""

import json
import socketserver
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from app.engine.outputs import receivers
from tests.app.web.conftest import serve

__all__ = ["serve"]


class Hook:
    """An HTTP server that keeps what it gets and answers with `code`."""

    def __init__(self):
        self.received, self.code = [], 200
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):  # noqa: N802
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if hook.code == 200:
                    hook.received.append((dict(self.headers), body))
                self.send_response(hook.code)
                self.send_header("Location", "http://127.0.0.1:9/")
                self.end_headers()

            def log_message(self, *args):
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    @property
    def section(self):
        return {"type": "webhook", "url": self.url}

    @property
    def alerts(self):
        return [json.loads(body) for _, body in self.received]


@pytest.fixture
def hook():
    made = Hook()
    yield made
    made.server.shutdown()
    made.server.server_close()


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
    monkeypatch.setattr(receivers, "TIMEOUT_S", 0.3)
    timer = threading.Timer
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Drip) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def dripping(first, late):
            monkeypatch.setattr(receivers.threading, "Timer", lambda seconds, end: timer(seconds + late, end))
            server.first = first
            return server.server_address[1]

        yield dripping
        server.shutdown()
