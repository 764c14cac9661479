"""The example of "Write an extension", built and installed as a package of its own, takes, sends and shows."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from zipfile import ZipFile

import pytest

from tests import ROOT
from tests.app.conftest import browser, shared_chromium
from tests.app.web.page.conftest import visit
from tests.support import free_port
from tests.waiting import LIMIT_S, wait_for

__all__ = ["browser", "shared_chromium", "visit"]

EXAMPLE = ROOT / "docs" / "examples" / "nisus_udp"
AT = 1_760_000_000  # s since 1970


@pytest.fixture
def site(tmp_path):
    """The folder of packages in which the example is installed, from its wheel."""
    copy, built, into = tmp_path / "copy", tmp_path / "built", tmp_path / "site"
    shutil.copytree(EXAMPLE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    built.mkdir()
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(built)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=copy, capture_output=True, check=True)
    with ZipFile(next(built.glob("*.whl"))) as wheel:
        wheel.extractall(into)
    return into


@pytest.mark.browser
def test_the_example_takes_datagrams_sends_the_state_and_shows_it(site, visit, tmp_path):
    receiver, port = socket.socket(type=socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(LIMIT_S)

    def sent():
        return json.loads(receiver.recv(65_535))

    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    text = re.sub(r"source:\n  type: simulator\n(  .*\n)*", f"source: {{type: udp, port: {port}}}\n", text)
    out = f"outputs: {{every: 0, udp: {{host: 127.0.0.1, port: {receiver.getsockname()[1]}}}}}\n"
    (tmp_path / "motor.yaml").write_text(text + out)
    words = ["run", "motor.yaml", "--no-browser", "--log-format", "text", "--port", str(free_port())]
    process = subprocess.Popen(
        [sys.executable, "-m", "app.cli.main", *words], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=(tmp_path / "lines").open("w"),
        env=os.environ | {"PYTHONPATH": f"{site}:{ROOT}"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        found = (re.search(r"http://127.0.0.1:\d+/\?token=\S+", line) for line in process.stdout)
        url = next(match[0] for match in found if match)
        sender = socket.socket(type=socket.SOCK_DGRAM)
        for k in range(3):
            message = {"time": (AT + k) * 10**9, "values": {"winding": 41.5}}
            sender.sendto(json.dumps(message).encode(), ("127.0.0.1", port))
        sender.sendto(b"nonsense", ("127.0.0.1", port))
        wait_for(lambda: sent()["time_ns"] == (AT + 2) * 10**9)
        page = visit(url)
        page.get_by_role("tab", name="States", exact=True).click()
        shown = wait_for(lambda: re.findall(r"(\S+) (-?\d+\.\d\d) (\S+)", page.locator("#panel-0").inner_text()))
        states = sent()["states"]
        assert [(name, unit) for name, _, unit in shown] == [(item["name"], item["unit"]) for item in states]
        # The estimate moves on between the two, by less than that: its rate is 0.2 °C/s.
        assert [float(value) for _, value, _ in shown] == pytest.approx([item["value"] for item in states], abs=2.0)
        assert "udp: Expecting value" in wait_for((tmp_path / "lines").read_text)
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(LIMIT_S)
        receiver.close()
