"""Alerts to HTTP servers: what counts as a failure."""

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from app.engine.outputs.alerts import heartbeat
from app.extensions.alerts.schema import WebhookSection
from app.extensions.alerts.webhook import Webhook
from tests.app.engine.outputs.test_alerts import assert_fails


@pytest.mark.parametrize("code", [302, 500])
def test_an_answer_that_is_no_success_counts_as_a_failure_and_is_not_followed(hook, code):
    hook.code = code
    with pytest.raises(OSError, match=f"it answers {code}"):
        Webhook(WebhookSection(type="webhook", url=hook.url), Path()).send(heartbeat("motor", "tracking"))


class Nonsense(BaseHTTPRequestHandler):
    """Answers with bytes of no protocol."""

    def do_POST(self):  # noqa: N802
        self.rfile.read(int(self.headers["Content-Length"]))
        self.wfile.write(b"nonsense\r\n\r\n")


def test_a_receiver_that_answers_nonsense_fails_as_any_other():
    class Silent:
        def send(self, alert):
            raise ConnectionError

    with HTTPServer(("127.0.0.1", 0), Nonsense) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        hook = Webhook(WebhookSection(type="webhook", url=f"http://127.0.0.1:{server.server_address[1]}/"), Path())
        for receiver, reason in ((hook, "nonsense"), (Silent(), "ConnectionError")):
            assert_fails(receiver, reason)
        server.shutdown()


@pytest.mark.parametrize(
    ("scheme", "first", "late"),
    [
        ("http", b"HTTP/1.1 200 OK\r\nX: ", 0.0),
        ("https", b"\x16\x03\x03\x40\x00", 0.0),
        ("https", b"\x16\x03\x03\x40\x00", 3.0),
    ],
)
def test_a_receiver_that_answers_byte_by_byte_fails_after_the_timeout(dripping, scheme, first, late):
    section = WebhookSection(type="webhook", url=f"{scheme}://127.0.0.1:{dripping(first, late)}/")
    with pytest.raises(OSError, match="it has not answered within 0.3 s"):
        Webhook(section, Path()).send(heartbeat("motor", "tracking"))
