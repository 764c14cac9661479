"""Alerts by e-mail and to programs."""

import json
import os
import socketserver
import sys
import threading
from types import SimpleNamespace

import pytest

from app.engine.outputs.alerts import heartbeat
from app.engine.outputs.receivers import Delivery
from app.extensions.alerts.command import CommandReceiver
from app.extensions.alerts.mail import Mail
from app.extensions.alerts.schema import CommandSection, EmailSection
from tests.app.engine.outputs.pushed import publishing, push
from tests.app.engine.outputs.test_alerts import assert_fails, started
from tests.waiting import LIMIT_S, wait_for


class MailServer(socketserver.StreamRequestHandler):
    """As much of SMTP as one message needs."""

    def handle(self):
        self.wfile.write(b"220 test\r\n")
        for line in self.rfile:
            word = line[:4].upper().strip()
            if word == b"DATA":
                self.wfile.write(b"354 go on\r\n")
                text = b"".join(iter(self.rfile.readline, b".\r\n"))
                self.server.mails.append(text.decode())
            self.wfile.write(b"221 bye\r\n" if word == b"QUIT" else b"250 ok\r\n")


def test_an_alert_is_sent_by_mail_and_to_a_program(serve, tmp_path):
    server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), MailServer)
    server.mails = []
    threading.Thread(target=server.serve_forever, daemon=True).start()
    place = {"server": "127.0.0.1", "port": server.server_address[1]}
    file = tmp_path / "alerts"
    program = "import sys; open(sys.argv[1], 'a').write(sys.stdin.read())"
    receivers = {
        "mail": {"type": "email", "to": "ops@plant", "sender": "nisus@plant", **place},
        "log": {"type": "command", "command": [sys.executable, "-c", program, str(file)]},
    }
    with publishing(serve, started(receivers)) as page:
        for k in range(30):
            push(page, (k, 50.0))
        # The program of the command has ended then.
        wait_for(lambda: [item["delivered"] for item in page.get("/api/alerts")["receivers"]] == [1, 1])
        (alert,) = page.get("/api/alerts")["alerts"]
    server.shutdown()
    server.server_close()
    (text,) = server.mails
    assert "Subject: [motor_winding] firing: temperature-above" in text
    assert json.loads(file.read_text())["id"] == alert["id"] and alert["id"] in text


def command(folder, *words):
    section = CommandSection(type="command", command=[sys.executable, "-c", *words], timeout=LIMIT_S)
    return CommandReceiver(section, folder, {})


def test_a_program_that_fails_is_told_by_the_code_that_it_ends_with(tmp_path):
    assert_fails(command(tmp_path, "import os, sys; os.write(2, bytes([255])); sys.exit(3)"), "it ended with 3")


def test_a_program_has_ended_although_it_leaves_one_running(tmp_path):
    os.mkfifo(tmp_path / "end")
    child = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', {!r}, sys.argv[1]])"
    leaves = command(tmp_path, child.format("import sys; open(sys.argv[1])"), str(tmp_path / "end"))
    for receiver in (command(tmp_path, "import os; os.write(2, bytes([255]))"), leaves):
        delivery = Delivery("ops", receiver, SimpleNamespace())
        delivery.put(heartbeat("motor", "tracking"))
        delivery.step()
        assert (delivery.delivered, delivery.waiting) == (1, 0)
    open(tmp_path / "end", "w").close()


@pytest.mark.parametrize(
    ("security", "first", "late"),
    [
        ("none", b"220 ", 0.0),
        ("tls", b"\x16\x03\x03\x40\x00", 0.0),
        ("tls", b"\x16\x03\x03\x40\x00", 3.0),
    ],
)
def test_a_mail_server_that_answers_byte_by_byte_fails_after_the_timeout(tmp_path, dripping, security, first, late):
    place = {"server": "127.0.0.1", "port": dripping(first, late), "security": security}
    section = EmailSection(type="email", to="ops@plant", sender="nisus@plant", **place)
    with pytest.raises(OSError, match="it has not answered within 0.3 s"):
        Mail(section, tmp_path, {}).send(heartbeat("motor", "tracking"))
