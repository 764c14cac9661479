"""Servers to which alerts are sent."""

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

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
