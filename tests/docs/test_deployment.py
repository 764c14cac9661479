"""The files for operating a service: nginx in front of it, and the steps of systemd unit and container."""

import configparser
import json
import os
import re
import shlex
import shutil
import ssl
import subprocess
import sys
from urllib.error import URLError
from urllib.request import HTTPSHandler, ProxyHandler, Request, build_opener, urlopen

import pytest
from websockets.sync.client import connect

from app.cli.main import parse
from app.cli.options import environment_options
from app.extensions.service.arguments import ServeCommand
from tests import ROOT
from tests.extensions.service.test_service import Served, all_run
from tests.skips import program
from tests.support import free_port
from tests.waiting import LIMIT_S, wait_for

TWIN = ROOT / "config" / "twins" / "motor_winding.yaml"
TOKEN = "b" * 24


@pytest.fixture
def folder(tmp_path):
    """A folder with a folder of twins and a file of tokens."""
    (tmp_path / "twins").mkdir()
    shutil.copy(TWIN, tmp_path / "twins" / "pump.yaml")
    (tmp_path / "tokens").write_text(f"bob tune {TOKEN}\n")
    (tmp_path / "tokens").chmod(0o600)
    return tmp_path


@pytest.fixture
def ports():
    return free_port(), free_port()


def test_nginx_adds_tls_and_the_audit_log_has_the_address_of_the_client(folder, ports):
    nginx, (port, public) = program("nginx"), ports
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate, "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    text = (ROOT / "docs" / "nginx.conf").read_text()
    for old, new in (
        ("443 ssl", f"127.0.0.1:{public} ssl"), ("127.0.0.1:9900", f"127.0.0.1:{port}"),
        ("twins.example.com;", "localhost;"),
        ("/etc/letsencrypt/live/twins.example.com/fullchain.pem", str(certificate)),
        ("/etc/letsencrypt/live/twins.example.com/privkey.pem", str(key)),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    places = "".join(
        f"{kind}_temp_path {folder}/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    head = f"daemon off;\npid {folder}/pid;\nerror_log {folder}/errors;\nevents {{}}\n"
    (folder / "nginx.conf").write_text(f"{head}http {{\naccess_log off;\n{places}{text}}}\n")
    site = f"https://localhost:{public}"
    trusted = ssl.create_default_context(cafile=certificate)
    nginx = subprocess.Popen([nginx, "-c", folder / "nginx.conf", "-p", folder], stderr=subprocess.PIPE)
    service = Served(folder, "twins", "--tokens", "tokens", "--public", site, "--port", str(port))
    try:
        service.wait(all_run)
        opener = build_opener(ProxyHandler({}), HTTPSHandler(context=trusted))
        bearer = {"Authorization": f"Bearer {TOKEN}"}

        def ask(path, body=None, **headers):
            data = None if body is None else json.dumps(body).encode()
            headers = bearer | {"Content-Type": "application/json"} | headers
            with opener.open(Request(site + path, data, headers), timeout=LIMIT_S) as answer:
                return answer.headers, answer.read().decode()

        headers, page = ask("/twins/pump/")
        assert 'src="../../page/page.js"' in page and f"wss://localhost:{public}" in headers["content-security-policy"]
        ask("/twins/pump/api/command", {"command": "SetTuning", "key": "Q.temperature", "value": 0.5}, Origin=site)
        (entry,) = json.loads(ask("/twins/pump/api/audit")[1])
        assert (entry["user"], entry["address"], entry["body"]["value"]) == ("bob", "127.0.0.1", 0.5)
        with pytest.raises(URLError, match="403"):
            ask("/twins/pump/api/command", {"command": "Undo"}, Origin="https://elsewhere.example")
        stream = f"wss://localhost:{public}/twins/pump/api/stream"
        with connect(
            stream, origin=site, additional_headers=bearer, ssl=trusted, proxy=None, open_timeout=LIMIT_S
        ) as socket:
            assert json.loads(socket.recv(timeout=LIMIT_S))["boot"]
        # The cookie of a browser is sent through TLS only.
        stays = subprocess.run(
            ["curl", "-s", "-o", os.devnull, "-D", "-", "--noproxy", "*", "--cacert", certificate,
             f"{site}/?token={TOKEN}"],
            check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        assert re.search(r"set-cookie: .*; Secure", stays, re.IGNORECASE) and TOKEN not in stays
    finally:
        service.stop()
        nginx.terminate()
        nginx.wait(LIMIT_S)


def test_the_unit_runs_a_command_that_exists_with_options_that_exist():
    unit = configparser.RawConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(ROOT / "docs" / "nisus.service")
    program, *words = shlex.split(unit["Service"]["ExecStart"])
    assert program == "/opt/nisus/bin/nisus"
    command = parse(words)
    assert isinstance(command, ServeCommand) and command.twins == ("/etc/nisus/twins",)
    lines = (ROOT / "docs" / "nisus.service").read_text().splitlines()
    variables = dict(
        line.removeprefix("Environment=").split("=", 1) for line in lines if line.startswith("Environment=")
    )
    found = environment_options("serve", ServeCommand, words[1:], variables)
    assert found == [
        "--log-format", "json", "--recordings", "/var/lib/nisus/recordings", "--store", "/var/lib/nisus/stores",
    ]  # fmt: skip
    if shutil.which("systemd-analyze"):
        told = subprocess.run(
            ["systemd-analyze", "verify", ROOT / "docs" / "nisus.service"], capture_output=True, text=True
        )
        assert [
            line for line in told.stderr.splitlines() if "nisus.service" in line and "not executable" not in line
        ] == []


def test_the_steps_of_the_container_serve_in_a_clean_folder(folder, ports):
    """With its entry point, environment and health check, as another user who can write to two folders only."""
    lines = re.sub(r"\\\n\s*", "", (ROOT / "docs" / "Dockerfile").read_text()).splitlines()
    steps = [line.partition(" ")[::2] for line in lines if line and not line.startswith("#")]
    values = dict(text.split("=", 1) for kind, text in steps if kind == "ENV")
    (entry,) = [json.loads(text) for kind, text in steps if kind == "ENTRYPOINT"]
    (check,) = [json.loads(text.partition("CMD ")[2]) for kind, text in steps if kind == "HEALTHCHECK"]
    assert [text for kind, text in steps if kind == "USER"] == ["nisus"] and entry[:2] == ["nisus", "serve"]
    port = ports[0]
    inside = {
        "/etc/nisus": str(folder),
        "/var/lib/nisus": str(folder / "lib"),
        "/var/cache/nisus": str(folder / "cache"),
    }

    def placed(text):
        for old, new in inside.items():
            text = text.replace(old, new)
        return text

    (folder / "lib").mkdir()
    cache = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    (folder / "cache").symlink_to(cache)  # compiled already
    words = [placed(word) for word in entry[1:]]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "HOME": "/nonexistent", "TMPDIR": str(folder)}
    environment |= {name: placed(value) for name, value in values.items()} | {"NISUS_SERVE_PORT": str(port)}
    with (folder / "lines").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "app.cli.main", *words],
            cwd=folder / "lib", env=environment, stdout=subprocess.DEVNULL, stderr=errors,
        )  # fmt: skip
    try:
        command = [sys.executable, "-c", check[2].replace("9900", str(port))]
        wait_for(lambda: process.poll() is not None or not subprocess.run(command, capture_output=True).returncode)
        assert process.poll() is None, (folder / "lines").read_text()
        request = Request(f"http://127.0.0.1:{port}/twins/pump/api/state", headers={"Authorization": f"Bearer {TOKEN}"})
        assert json.load(urlopen(request, timeout=LIMIT_S))["twin"] == "pump"
    finally:
        process.terminate()
        assert process.wait(LIMIT_S) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["cache", "lib", "lines", "tokens", "twins"]
    assert [path.name for path in (folder / "lib" / "stores").iterdir()] == ["pump.store"]
    assert all(json.loads(line)["twin"] == "pump" for line in (folder / "lines").read_text().splitlines())
